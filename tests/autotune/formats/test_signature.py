"""Signatures: the standard's own test vectors, keys made by other tools, and everything that is none."""

import shutil
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)

from autotune.errors import CertificateError, UsageError
from autotune.formats.signature import (
    check_signature,
    check_signature_target,
    fingerprint,
    read_private_key,
    read_public_key,
    sign_file,
    signature_path,
    unverified_signature,
)

CONTENT = b"format: autotune/controller\n"
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
# RFC 8032, section 7.1: secret key, public key, message, signature.
VECTORS = [
    (
        "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
        "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
        "",
        (
            "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701cf9b46b"
            "d25bf5f0595bbe24655141438e7a100b"
        ),
    ),
    (
        "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb",
        "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
        "72",
        (
            "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e458f3613d0f11d8c"
            "387b2eaeb4302aeeb00d291612bb0c00"
        ),
    ),
]


def digest(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def written(path: Path, data: bytes = CONTENT) -> Path:
    path.write_bytes(data)
    path.chmod(0o600)
    return path


def pem(key: Ed25519PrivateKey, path: Path) -> Path:
    return written(path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


@pytest.mark.parametrize(("secret", "public", "message", "signature"), VECTORS)
def test_the_vectors_of_the_standard(tmp_path: Path, secret: str, public: str, message: str, signature: str) -> None:
    path = written(tmp_path / "message", bytes.fromhex(message))
    key = Ed25519PrivateKey.from_private_bytes(bytes.fromhex(secret))
    reported = sign_file(path, read_private_key(pem(key, tmp_path / "key.pem")), digest(path))
    assert signature_path(path).read_bytes().hex() == signature
    expected = Ed25519PublicKey.from_public_bytes(bytes.fromhex(public))
    assert reported == fingerprint(expected) == sha256(bytes.fromhex(public)).hexdigest()[:16]
    assert check_signature(path, expected, digest(path)) == reported


@pytest.mark.parametrize("style", ["openssl", "ssh-keygen"])
def test_keys_of_other_tools_sign_and_other_tools_verify(tmp_path: Path, style: str) -> None:
    if shutil.which(style) is None or shutil.which("openssl") is None:
        pytest.skip(f"{style} is not installed")
    private, public, path = tmp_path / "key", tmp_path / "key.pub", written(tmp_path / "c.yaml")
    if style == "openssl":
        _run("openssl", "genpkey", "-algorithm", "ed25519", "-out", private)
        _run("openssl", "pkey", "-in", private, "-pubout", "-out", public)
    else:
        _run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", private)
    reported = sign_file(path, read_private_key(private), digest(path))
    assert check_signature(path, read_public_key(public), digest(path)) == reported
    if style == "openssl":
        verify = ("pkeyutl", "-verify", "-pubin", "-inkey", public, "-rawin", "-in", path, "-sigfile", f"{path}.sig")
        _run("openssl", *verify)


def _run(*command: str | Path) -> None:
    subprocess.run(command, check=True, capture_output=True)


def test_whatever_was_changed_the_signature_is_refused(tmp_path: Path) -> None:
    path, other = written(tmp_path / "c.yaml"), Ed25519PrivateKey.from_private_bytes(bytes(32))
    sign_file(path, KEY, digest(path))
    good = signature_path(path).read_bytes()
    with pytest.raises(CertificateError, match=f"by the key {fingerprint(other.public_key())}; the file was changed"):
        check_signature(path, other.public_key(), digest(path))
    for bad in (b"", good[:-1], good + b"\n", bytes([good[0] ^ 1]) + good[1:], bytes(64)):
        signature_path(path).write_bytes(bad)
        with pytest.raises(CertificateError, match=r"c\.yaml\.sig is not a signature of"):
            check_signature(path, KEY.public_key(), digest(path))
    signature_path(path).write_bytes(good)
    written(path, CONTENT + b"# a comment\n")
    with pytest.raises(CertificateError, match="is not a signature"):
        check_signature(path, KEY.public_key(), digest(path))
    signature_path(path).unlink()
    with pytest.raises(CertificateError, match=r"must be signed, but .*c\.yaml\.sig cannot be read"):
        check_signature(path, KEY.public_key(), digest(path))


def test_a_signature_takes_the_place_of_a_signature_only(tmp_path: Path) -> None:
    path = written(tmp_path / "c.yaml")
    beside, kept = signature_path(path), written(tmp_path / "kept", b"of somebody else")
    assert check_signature_target(path) == ""
    for foreign in (b"minutes of a meeting\n", bytes(range(65)), b"0123456789abcdef" * 4):
        written(beside, foreign)
        with pytest.raises(UsageError, match=r"c\.yaml\.sig exists and is no signature, so it is not replaced"):
            sign_file(path, KEY, digest(path))
        assert beside.read_bytes() == foreign
    beside.unlink()
    beside.symlink_to(kept)
    with pytest.raises(UsageError, match=r"c\.yaml\.sig is a symbolic link"):
        sign_file(path, KEY, digest(path))
    assert (beside.is_symlink(), kept.read_bytes()) == (True, b"of somebody else")
    beside.unlink()
    sign_file(path, Ed25519PrivateKey.from_private_bytes(bytes(32)), digest(path))
    assert check_signature_target(path) == f"the signature of sha256 {digest(beside)[:8]}"
    sign_file(path, KEY, digest(path))
    assert check_signature(path, KEY.public_key(), digest(path)) == fingerprint(KEY.public_key())


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o644, 0o666])
def test_a_private_key_that_others_have_access_to_signs_nothing(tmp_path: Path, mode: int) -> None:
    path = pem(KEY, tmp_path / "key.pem")
    path.chmod(mode)
    with pytest.raises(UsageError, match=rf"others than its owner have access to \(mode {mode:o}\).*chmod 600"):
        read_private_key(path)
    path.chmod(0o400)
    assert fingerprint(read_private_key(path).public_key()) == fingerprint(KEY.public_key())


def test_without_the_library_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(UsageError, match="the Python package cryptography, which is not installed here"):
        read_public_key(written(tmp_path / "key"))


def test_a_signature_that_nobody_asked_for_is_not_passed_over(tmp_path: Path) -> None:
    path = written(tmp_path / "c.yaml")
    assert unverified_signature(path) == ""
    written(signature_path(path), bytes(64))
    assert "c.yaml.sig was not verified, since no key was given" in unverified_signature(path)


def test_a_file_that_changed_under_the_reader_is_not_signed(tmp_path: Path) -> None:
    path = written(tmp_path / "c.yaml")
    before = digest(path)
    written(path, b"another")
    with pytest.raises(CertificateError, match="was replaced while it was being verified"):
        sign_file(path, KEY, before)
    assert not signature_path(path).exists()


def test_a_key_that_is_none_is_reported(tmp_path: Path) -> None:
    curve = generate_private_key(SECP256R1())
    files = {
        "another kind": curve.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
        "protected by a password": KEY.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"x")),
        "found none that can be read": b"not a key",
    }
    for reported, data in files.items():
        with pytest.raises(UsageError, match=reported):
            read_private_key(written(tmp_path / "key", data))
    public = {
        "another kind": curve.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH),
        "found none that can be read": b"ssh-ed25519 AAAA",
    }
    for reported, data in public.items():
        with pytest.raises(UsageError, match=reported):
            read_public_key(written(tmp_path / "key", data))
    with pytest.raises(UsageError, match="cannot be read"):
        read_public_key(tmp_path / "absent")
    with pytest.raises(UsageError, match="cannot be read"):
        read_private_key(tmp_path)
