"""Write an export that is a folder, whole or not at all, and recognise an earlier one by the list that it holds."""

from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path

from autotune.errors import AutotuneError, UsageError
from autotune.formats.atomic import check_target, write_folder_atomic
from autotune.formats.canonical import dump_yaml
from autotune.formats.yaml12 import load_yaml

LIST = "autotune_export.yaml"
"""The file with the names and digests of all others, by which a folder of this tool is known."""
_FORMAT = "autotune/export_folder"


def check_folder(folder: Path, source: Path | str) -> bool:
    """Return whether an earlier export will be replaced; raises UsageError where anything else would be lost."""
    check_target(folder, [source])
    if not folder.exists():
        return False
    advice = "so it is not replaced; name another folder with -o"
    if not folder.is_dir():
        raise UsageError(f"{folder} is a file, and this export is a folder, {advice}.")
    present = {str(each.relative_to(folder)) for each in folder.rglob("*") if not each.is_dir() or each.is_symlink()}
    if not present:
        return False
    if LIST not in present:
        raise UsageError(f"{folder} exists and is no earlier export, {advice}.")
    digests = _digests(folder / LIST)
    strange = sorted(present - {LIST} - set(digests))
    if strange:
        raise UsageError(f"{folder} holds {strange[0]} beside an earlier export, which would be lost, {advice}.")
    changed = [name for name in sorted(present - {LIST}) if _digest((folder / name).read_bytes()) != digests[name]]
    if changed:
        raise UsageError(f"{folder / changed[0]} was changed since it was exported, {advice}.")
    return True


def write_folder(folder: Path, texts: Mapping[str, str]) -> None:
    """Write the texts by their names inside of the folder, and their list, in one step."""
    digests = {name: _digest(text.encode()) for name, text in texts.items()}
    listed = dump_yaml({"format": _FORMAT, "version": 1, "files": digests})
    write_folder_atomic(folder, {**texts, LIST: listed})


def _digests(path: Path) -> dict[str, str]:
    try:
        tree = load_yaml(path, error=UsageError)
    except AutotuneError:
        tree = {}
    found = tree.get("files")
    if tree.get("format") != _FORMAT or not isinstance(found, dict):
        raise UsageError(
            f"{path} is no list of an export, so {path.parent} is not replaced; name another folder with -o."
        )
    return {str(name): str(digest) for name, digest in found.items()}


def _digest(data: bytes) -> str:
    return sha256(data).hexdigest()
