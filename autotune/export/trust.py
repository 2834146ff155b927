"""What must hold of a controller file before anything is exported from it: who signed it, which one it is, its law."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from autotune.errors import CertificateError
from autotune.formats.controller import ControllerFile
from autotune.runtime.load import check_digits, check_expected, verify_signature
from autotune.validation.validate import validate_controller


@dataclass(frozen=True, kw_only=True)
class Trust:
    """What is asked of the file: the signature of a key (a file, PEM or OpenSSH), its checksum (64 digits), or neither.

    Raises UsageError: the checksum is not 64 hexadecimal digits.
    """

    public_key: Path | None = None
    expected_checksum: str | None = None

    def __post_init__(self) -> None:
        if self.expected_checksum is not None:
            check_digits(self.expected_checksum)

    def verify(self, source: ControllerFile) -> str | None:
        """Return the fingerprint of the key that signed the file, None where no key is asked for.

        Raises CertificateError: the file is not signed by the key, or another one. UsageError: the key cannot be read.
        """
        signed_by = None
        if self.public_key is not None:
            signed_by = verify_signature(source.path, self.public_key, source.sha256)
        if self.expected_checksum is not None:
            check_expected(self.expected_checksum, source.checksum, source.path)
        return signed_by


def check_law(source: ControllerFile, progress: Callable[[float], None] | None = None) -> None:
    """Raise CertificateError unless the law is stable, has its margins at the recorded plants, and keeps its limits.

    Stable over the whole domain, and within the limits in the hardest of the predicted contacts. The checksum can be
    made anew by anybody; what a law does cannot.
    """
    try:
        validate_controller(source.controller, progress, is_short=True).require()
    except CertificateError as reason:
        raise CertificateError(f"{source.path} is false, so nothing is exported from it: {reason}") from reason
