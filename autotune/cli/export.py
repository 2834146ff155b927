"""`autotune export`: a validated controller in the format that another program reads."""

from pathlib import Path
from typing import Any

import click

from autotune.export.targets import TARGETS, target_options

from ._common import Output, output_options
from ._options import KEYS, SETTINGS, FilePath, GroupedCommand
from ._terminal import print_message

_EPILOG = """\b
Examples:
  autotune export controller.yaml --target json -o controller.json
  autotune export controller.yaml --target c -o cell.c --public-key pub.pem
  autotune export controller.yaml --target ros2_control --ros2-version jazzy -o admittance.yaml
  autotune export controller.yaml --target ros2_package -o my_admittance
"""


def _target_options(function: Any) -> Any:
    """Add the options that the targets declare."""
    for option in reversed(list(target_options())):
        function = click.option(option.flag, option.name, metavar=option.metavar, type=option.type, help=option.help)(
            function
        )
    return function


_NAMED = 3


def _groups() -> dict[str, list[str]]:
    """Return the options of the targets under headings that name the targets."""
    groups: dict[str, list[str]] = {}
    for option, names in target_options().items():
        shown = names if len(names) <= _NAMED else (*names[: _NAMED - 1], f"{len(names) - _NAMED + 1} others")
        groups.setdefault(f"For {' and '.join(shown)}", []).append(option.name)
    return groups


@click.command(
    "export",
    cls=GroupedCommand,
    groups=_groups(),
    short_help="Write a controller in another format.",
    epilog=_EPILOG,
)
@click.argument("controller", type=FilePath(*SETTINGS, kinds=("controller",)))
@click.option(
    "--target",
    type=click.Choice(list(TARGETS)),
    metavar="TARGET",
    required=True,
    help=" ".join(f"{target.name}: {target.summary}" for target in TARGETS.values()),
)
@click.option(
    "-o",
    "--output",
    "out",
    type=click.Path(path_type=Path),
    required=True,
    metavar="OUT",
    help="The file to write (of c: NAME.c, with NAME.h beside it; of ros2_package a folder). An earlier export to the "
    "same target is replaced, once the new one is whole; anything else is left alone.",
)
@click.option(
    "--public-key", type=FilePath(*KEYS), help="Demand the signature CONTROLLER.sig, by the key of this file."
)
@click.option("--expected-checksum", metavar="64 DIGITS", help="Demand the file of this whole checksum.")
@_target_options
@output_options
def command(
    output: Output,
    /,
    controller: Path,
    target: str,
    out: Path,
    public_key: Path | None,
    expected_checksum: str | None,
    **further: Any,
) -> None:
    """Verify CONTROLLER and write it in the format of another program.

    A file that is altered, not validated, not signed by the key, or whose law is not stable over its domain with the
    margins that it states is refused (exit code 6). The short checksum is for people to compare with what the cell
    shows; a program compares all 64 digits.

    Controllers of others run other laws. For them the parameters are translated, what they cannot express is dropped,
    and what remains is certified again over the file's domain; if that fails, the best that they can do is tuned, and
    the price in peak force is printed. If nothing meets the requirements, nothing is written (exit code 5).
    """
    from autotune.export.export import Trust, export_controller
    from autotune.formats.canonical import short
    from autotune.prediction.as_run_by import own_law_notes

    options = {option.name: option for option in target_options()}
    given = {name: options[name].parse(value) for name, value in further.items() if value is not None}
    trust = Trust(public_key=public_key, expected_checksum=expected_checksum)
    with output.progress("verifying", 1.0) as advance:
        made = export_controller(controller, target, out, options=given, trust=trust, progress=advance)
    _note_unverified(output, controller, public_key)
    if made.target.runs_same_law:
        for note in own_law_notes(made.source.controller):
            output.note(note)
    result = {
        "target": target,
        "path": str(out),
        "checksum": made.checksum,
        "short_checksum": short(made.checksum),
        "replaced": bool(made.replaced),
        **made.rendered.tree,
    }

    def text() -> None:
        origin = "" if made.target.runs_same_law else "from the file with "
        print_message(f"{out}: {target}, {origin}checksum {short(made.checksum)}")
        for path in made.replaced:
            print_message(f"{path}: an earlier export --target {target} was replaced")
        for line in made.rendered.lines:
            print_message(line)

    output.result(result, text)
    if made.following is None:
        output.next_command("report", controller)
    else:
        output.next_line(made.following)


def _note_unverified(output: Output, controller: Path, public_key: Path | None) -> None:
    """Say that there is a signature which was not verified."""
    from autotune.formats.signature import unverified_signature

    if public_key is None and (remark := unverified_signature(controller)):
        output.note(remark)
