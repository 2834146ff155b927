"""`autotune export`: a validated controller in the format that another program reads."""

from pathlib import Path

import click

from autotune.exports.targets import EVERY_TARGET

from ._common import Output, output_options


@click.command(
    "export",
    short_help="Write a controller in another format.",
    epilog="Example: autotune export controller.yaml --target json -o controller.json",
)
@click.argument("controller", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--target",
    type=click.Choice(list(EVERY_TARGET)),
    required=True,
    help="cell: the YAML that the cell reads. json: the same content as JSON, with a JSON Schema. "
    "c: the controller's step as one C99 source, and the header beside it.",
)
@click.option(
    "-o",
    "--output",
    "out",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    metavar="OUT",
    help="The file to write (of c: NAME.c, with NAME.h beside it); it is replaced only once the new one is whole.",
)
@output_options
def command(output: Output, controller: Path, target: str, out: Path) -> None:
    """Verify CONTROLLER and write it in the format of another program.

    A file that is altered or not validated is refused (exit code 6). The short checksum is for people to compare with
    what the cell shows.
    """
    from autotune.exports.targets import export_controller
    from autotune.files.canonical import short

    checksum = export_controller(controller, target, out)
    result = {"target": target, "path": str(out), "checksum": checksum, "short_checksum": short(checksum)}
    output.result(result, lambda: click.echo(f"{out}: {target}, checksum {short(checksum)}"))
