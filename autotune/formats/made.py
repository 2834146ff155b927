"""The list of files that one command made in a folder of its own: only those, unchanged, may be replaced by it."""

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from autotune.errors import UsageError

from .atomic import write_atomic
from .canonical import short
from .dump import dump_yaml
from .yaml12 import load_yaml

LIST = "demo.yaml"
FORMAT = "autotune/demo"
_CHUNK = 2**20


class MadeHere:
    """What a demo made in `folder`, by name and sha256, kept there as `demo.yaml`; `replaced` stood there before.

    Raises UsageError where one of `names` stands for a file that is not on that list, or was changed since.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.path = folder / LIST
        self._digests = self._former()
        standing = [folder / name for name in names if (folder / name).exists()]
        for path in standing:
            if not path.is_file() or self._digests.get(path.name) != _digest(path):
                raise UsageError(
                    f"{path} exists and is not what a demo made there, so it is not replaced; name another folder."
                )
        self.replaced = tuple(f"{path} (sha256 {short(self._digests[path.name])})" for path in standing)

    def add(self, path: Path) -> None:
        """Note a file that was just written; raises as `write_atomic`."""
        self._digests[path.name] = _digest(path)
        write_atomic(self.path, dump_yaml({"format": FORMAT, "version": 1, "made": dict(self._digests)}))

    def _former(self) -> dict[str, str]:
        if not self.path.exists():
            return {}
        tree = load_yaml(self.path, error=UsageError)
        made = tree.get("made")
        if tree.get("format") != FORMAT or not isinstance(made, dict):
            raise UsageError(
                f"{self.path} exists and is no list of a demo, so it is not replaced; name another folder."
            )
        return {str(name): str(digest) for name, digest in made.items()}


def _digest(path: Path) -> str:
    found = sha256()
    with path.open("rb") as stream:
        while part := stream.read(_CHUNK):
            found.update(part)
    return found.hexdigest()
