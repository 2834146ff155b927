"""How the frames of a log become ours."""

from dataclasses import dataclass

from scipy.spatial.transform import Rotation


@dataclass(frozen=True, kw_only=True)
class Frames:
    """What the cell declares: `R_FS` flange from sensor, `R_WB` our base (gravity along −z) from the log's."""

    R_FS: Rotation
    R_WB: Rotation

    @classmethod
    def plain(cls) -> "Frames":
        """Return frames that are all the same."""
        return cls(R_FS=Rotation.identity(), R_WB=Rotation.identity())
