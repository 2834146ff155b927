"""Signatures of files, Ed25519, each in a file of its own beside what it signs.

The checksum in a file shows that nothing was changed by accident; a signature shows who vouches for it.
"""

import os
import stat
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from autotune.errors import CertificateError, UsageError

from .atomic import check_target, write_atomic
from .canonical import short

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

_LARGEST_KEY_BYTES, _SIGNATURE_BYTES = 65536, 64
_PEM, _OPENSSH_PRIVATE = b"-----BEGIN ", b"-----BEGIN OPENSSH"


def signature_path(path: Path) -> Path:
    """Return the path of a file's signature: its name with `.sig` behind."""
    return path.with_name(f"{path.name}.sig")


def read_private_key(path: Path) -> "Ed25519PrivateKey":
    """Return an Ed25519 key from a PEM file (PKCS #8) or one of OpenSSH, without password; else raises UsageError.

    So it does where the key can be read by others than its owner: whoever read it can sign in the owner's name.
    """
    _check_private(path)
    _check_library()
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415 - slow to import, and rarely needed
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 - the same

    data = _key_bytes(path)
    load: Callable[..., object] = (
        serialization.load_ssh_private_key if data.startswith(_OPENSSH_PRIVATE) else serialization.load_pem_private_key
    )
    key = _loaded(lambda: load(data, password=None), path, "private")
    if not isinstance(key, Ed25519PrivateKey):
        raise UsageError(f"{path} must hold an Ed25519 private key, found one of another kind.")
    return key


def read_public_key(path: Path) -> "Ed25519PublicKey":
    """Return an Ed25519 key from a PEM file or one of OpenSSH; else raises UsageError."""
    _check_library()
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415 - slow to import, and rarely needed
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415 - the same

    data = _key_bytes(path)
    load: Callable[..., object] = (
        serialization.load_pem_public_key if data.startswith(_PEM) else serialization.load_ssh_public_key
    )
    key = _loaded(lambda: load(data), path, "public")
    if not isinstance(key, Ed25519PublicKey):
        raise UsageError(f"{path} must hold an Ed25519 public key, found one of another kind.")
    return key


def sign_file(path: Path, key: "Ed25519PrivateKey", digest: str) -> str:
    """Write the signature (64 bytes) of the bytes of `path` beside it and return the fingerprint of the key.

    Raises CertificateError when the file is no longer the one of sha256 `digest`, UsageError when it cannot be written,
    or would replace what is no signature.
    """
    check_signature_target(path)
    write_atomic(signature_path(path), key.sign(_same_bytes(path, digest)))
    return fingerprint(key.public_key())


def check_signature_target(path: Path) -> str:
    """Return which signature one of `path` will replace, in words; "" where nothing would be lost.

    Raises UsageError where a symbolic link or a file that is no signature is there, or where nothing can be written.
    """
    beside = signature_path(path)
    if beside.is_symlink():
        raise UsageError(f"{beside} is a symbolic link, through which no signature is written; remove it.")
    check_target(beside)
    if not beside.exists():
        return ""
    try:
        with beside.open("rb") as stream:
            found = stream.read(_SIGNATURE_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{beside} cannot be read: {error.strerror or error}.") from error
    # A text of 64 characters is none: of random bytes half are above 127.
    if found and (len(found) != _SIGNATURE_BYTES or found.isascii()):
        raise UsageError(f"{beside} exists and is no signature, so it is not replaced; move it away.")
    return f"the signature of sha256 {short(sha256(found).hexdigest())}" if found else ""


def check_signature(path: Path, key: "Ed25519PublicKey", digest: str) -> str:
    """Return the fingerprint of the key if it signed the bytes of `path`, those of sha256 `digest`.

    Raises CertificateError when there is no signature, or it is not one of this key over these bytes.
    """
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - slow to import, and rarely needed

    beside = signature_path(path)
    try:
        with beside.open("rb") as stream:
            signature = stream.read(_LARGEST_KEY_BYTES)
    except OSError as error:
        raise CertificateError(
            f"{path} must be signed, but {beside} cannot be read: {error.strerror or error}."
        ) from error
    try:
        key.verify(signature, _same_bytes(path, digest))
    except InvalidSignature as error:
        raise CertificateError(
            f"{beside} is not a signature of {path} by the key {fingerprint(key)}; the file was changed after it was "
            "signed, or another key signed it."
        ) from error
    return fingerprint(key)


def fingerprint(key: "Ed25519PublicKey") -> str:
    """Return the first 16 hexadecimal digits of the sha256 of the public key's 32 bytes, for people to compare."""
    return sha256(key.public_bytes_raw()).hexdigest()[:16]


def unverified_signature(path: Path) -> str:
    """Say that a signature lies beside `path` and was not verified; "" where there is none."""
    beside = signature_path(path)
    if not beside.is_file():
        return ""
    return f"{beside} was not verified, since no key was given; name the key of whoever signs with --public-key."


def _check_private(path: Path) -> None:
    if os.name != "posix":  # elsewhere the mode says nothing of who may read
        return
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise UsageError(
            f"{path} is a private key that others than its owner have access to (mode {mode:03o}), so nothing is "
            f"signed with it; make it yours alone (chmod 600 {path}), or make a new key if somebody may have read it."
        )


def _check_library() -> None:
    try:
        import cryptography  # noqa: F401, PLC0415 - asked for, and slow to import
    except ImportError as error:
        raise UsageError(
            "A signature is verified with the Python package cryptography, which is not installed here; install it, or "
            "verify the file on another machine (autotune validate --public-key) and compare the whole checksum."
        ) from error


def _same_bytes(path: Path, digest: str) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    if sha256(data).hexdigest() != digest:
        raise CertificateError(f"{path} was replaced while it was being verified; run the command again.")
    return data


def _key_bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(_LARGEST_KEY_BYTES).lstrip()
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error


def _loaded(load: Callable[[], object], path: Path, kind: str) -> object:
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - slow to import, and rarely needed

    try:
        return load()
    except TypeError as error:
        raise UsageError(
            f"{path} is protected by a password, which this command does not ask for; give a key without one."
        ) from error
    except (ValueError, UnsupportedAlgorithm) as error:
        must = f"must hold an Ed25519 {kind} key as PEM or in the form of OpenSSH"
        raise UsageError(f"{path} {must}, found none that can be read.") from error
