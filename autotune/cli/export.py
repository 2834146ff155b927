"""`autotune export`: a validated controller in the format that another program reads."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.export.targets import EVERY_TARGET, PEER_TARGETS

from ._common import Output, output_options
from ._options import KEYS, SETTINGS, FilePath, GroupedCommand
from ._terminal import print_message

if TYPE_CHECKING:
    from autotune.export.trust import Trust

_EPILOG = """\b
Examples:
  autotune export controller.yaml --target json -o controller.json
  autotune export controller.yaml --target c -o cell.c --public-key pub.pem
  autotune export controller.yaml --target ros2_control --ros2-version jazzy -o admittance.yaml
"""
_FOR_PEERS = (
    click.option(
        "--ros2-version",
        "version",
        metavar="NAME",
        help="humble, jazzy (default), kilted, lyrical, rolling, or as 6.4.0.",
    ),
    click.option("--controller-name", metavar="NAME", help="The name of the controller in the parameter file."),
    click.option("--joints", metavar="NAME,…", help="The robot's joints, from base to tip (joint_1 to joint_6)."),
    click.option("--base-link", metavar="NAME", help="The robot's base (base_link)."),
    click.option("--tip-link", metavar="NAME", help="The robot's last link (tool0)."),
    click.option("--sensor-name", metavar="NAME", help="The force sensor in the robot description (ft_sensor)."),
    click.option("--sensor-frame", metavar="NAME", help="The frame of its wrench (ft_frame)."),
    click.option(
        "--orientation",
        metavar="QX,QY,QZ,QW",
        help="fzi_cartesian: the sensor's orientation in the base where it is used, for gains that are not alike.",
    ),
    click.option("--control-frame", metavar="NAME", help="The frame of the tuned axes (the sensor's)."),
    click.option(
        "--return-stiffness",
        type=float,
        metavar="N/M",
        help="ros2_control: the spring without which there is no damping there (so weak that it takes 10 h).",
    ),
    click.option(
        "--filter-coefficient", type=float, metavar="A", help="ros2_control: the force filter, 1 being none (1)."
    ),
)


_GROUPS = {
    "For ros2_control and fzi_cartesian": (
        *("version", "controller_name", "joints", "base_link", "tip_link", "sensor_name", "sensor_frame"),
        *("orientation", "control_frame", "return_stiffness", "filter_coefficient"),
    ),
}


def _peer_options(command: Any) -> Any:
    for option in reversed(_FOR_PEERS):
        command = option(command)
    return command


@click.command(
    "export",
    cls=GroupedCommand,
    groups=_GROUPS,
    short_help="Write a controller in another format.",
    epilog=_EPILOG,
)
@click.argument("controller", type=FilePath(*SETTINGS))
@click.option(
    "--target",
    type=click.Choice([*EVERY_TARGET, *PEER_TARGETS]),
    required=True,
    help="cell: the YAML that the cell reads. json: the same content as JSON, with a JSON Schema. c: the controller's "
    "step as one C99 source, and the header beside it. ros2_control: parameters of the admittance controller of "
    "ros2_controllers. fzi_cartesian: parameters of FZI's Cartesian force controller.",
)
@click.option(
    "-o",
    "--output",
    "out",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    metavar="OUT",
    help="The file to write (of c: NAME.c, with NAME.h beside it). An earlier export to the same target is replaced, "
    "once the new one is whole; any other file is left alone.",
)
@click.option(
    "--public-key", type=FilePath(*KEYS), help="Demand the signature CONTROLLER.sig, by the key of this file."
)
@click.option("--expected-checksum", metavar="64 DIGITS", help="Demand the file of this whole checksum.")
@_peer_options
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
    the price in peak force is told. If nothing meets the requirements, nothing is written (exit code 5).
    """
    from autotune.errors import UsageError
    from autotune.export.replace import standing
    from autotune.export.targets import export_controller
    from autotune.export.trust import Trust
    from autotune.formats.canonical import short

    trust = Trust(public_key=public_key, expected_checksum=expected_checksum)
    given = {name: value for name, value in further.items() if value is not None}
    if target in PEER_TARGETS:
        _export_peer(output, controller, target, out, given, trust)
        return
    if given:
        raise UsageError(f"The target {target} takes no names, versions or numbers of another controller.")
    earlier = standing(out, target)
    with output.progress("verifying", 1.0) as advance:
        checksum = export_controller(controller, target, out, trust, advance)
    _note_unverified(output, controller, public_key)
    result = {"target": target, "path": str(out), "checksum": checksum, "short_checksum": short(checksum)}

    def text() -> None:
        print_message(f"{out}: {target}, checksum {short(checksum)}")
        _tell_replaced(earlier, target)

    output.result({**result, "replaced": bool(earlier)}, text)


def _note_unverified(output: Output, controller: Path, public_key: Path | None) -> None:
    """Say that there is a signature which was not looked at."""
    from autotune.formats.signature import unverified_signature

    if public_key is None and (remark := unverified_signature(controller)):
        output.note(remark)


def _tell_replaced(earlier: tuple[Path, ...], target: str) -> None:
    for path in earlier:
        print_message(f"{path}: an earlier export --target {target} was replaced")


def _export_peer(
    output: Output, controller: Path, target: str, out: Path, given: dict[str, Any], trust: "Trust"
) -> None:
    """Certify, write and tell what was kept, what was dropped and what it costs."""
    from autotune.export.fzi_axes import parse_orientation
    from autotune.export.peers import export_peer, peer_options
    from autotune.export.replace import standing
    from autotune.formats.canonical import short

    if "joints" in given:
        given["joints"] = tuple(name.strip() for name in given["joints"].split(","))
    if "orientation" in given:
        given["orientation"] = parse_orientation(given["orientation"])
    options = peer_options(target, given)
    earlier = standing(out, target)
    with output.progress("certifying", 1.0) as advance:
        made = export_peer(controller, options, out, advance, trust)
    _note_unverified(output, controller, trust.public_key)
    checksum = made.source.checksum
    head: dict[str, Any] = {"target": target, "path": str(out), "checksum": checksum, "short_checksum": short(checksum)}
    head["replaced"] = bool(earlier)

    def text() -> None:
        print_message(f"{out}: {target}, from the file with checksum {short(checksum)}")
        _tell_replaced(earlier, target)
        for axis in made.axes:
            how = "translated" if axis.tuned_because is None else f"tuned anew, since {axis.tuned_because}"
            numbers = ", ".join(f"{name} {value:g}" for name, value in axis.written.items())
            print_message(f"axis {axis.axis}: {numbers} ({how})")
            print_message(f"axis {axis.axis}: peak force {axis.price()}")
            for note in axis.notes:
                print_message(note)
        for line in made.dropped:
            print_message(f"dropped: {line}")
        for line in made.notes:
            print_message(f"note: {line}")

    output.result({**head, **made.tree()}, text)
