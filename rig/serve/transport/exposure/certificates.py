"""Certificates of an exposed rig: one authority, and a folder for each holder.

The authority's key signs the certificates and is discarded, unless it is kept to add devices later. A holder's folder
is complete (`authority.pem`, `certificate.pem`, `key.pem`), so that it can be copied to the client's computer. The
rig's own folder lists the common names that it admits: zenoh cannot revoke a certificate, but its access control denies
everything to a name without rules.
"""

from __future__ import annotations

import ipaddress
import os
import re
import secrets
import shutil
import socket
import ssl
import tempfile
from collections.abc import Collection, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.base.errors import InputError, Words
from rig.base.files import read_file, write_file
from rig.serve.transport.exposure.access import DEVICE_NAME, ROLE_NAMES, ROLES, WITH_TRUTH, get_device

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

SERVER, AUTHORITY, SIGNER = "server", "authority", "rig authority"
HOLDERS = (SERVER, *ROLES)
_AUTHORITY, _CERTIFICATE, _KEY = _FILES = ("authority.pem", "certificate.pem", "key.pem")
_ALLOWED = "allowed.txt"
"""File in the rig's folder: the common names that it admits, one a line."""
_MAX_BYTES = 1 << 20
"""Largest file of a certificate, a key or a list [bytes]."""
_NAME = re.compile(rf"({'|'.join(ROLES)})({re.escape(WITH_TRUTH)})?(@{DEVICE_NAME}\.[0-9a-f]{{8}})?")
"""Common name of a client's certificate: the number distinguishes it from a withdrawn one of the same device."""
_SKEW = timedelta(hours=1)
"""Allowed difference between clocks."""
_HOST = re.compile(r"(?=.{1,64}\Z)[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?)*")


class Holder(NamedTuple):
    """A checked folder of one holder.

    Args:
        folder: Its path.
        name: Common name of the certificate; for a client a role, or `ROLE@DEVICE.NUMBER`.
        expires: Expiry of the certificate.
        allowed: Common names that a rig with this folder admits.
    """

    folder: Path
    name: str
    expires: datetime
    allowed: tuple[str, ...]

    def describe_expiry(self) -> str:
        """Return the folder and when its certificate expired."""
        return f"{self.folder}, expired on {self.expires:%Y-%m-%d %H:%M} UTC"

    def settings(self, *, listens: bool) -> dict[str, Any]:
        """Return zenoh's TLS settings for the listening or the connecting side."""
        side = "listen" if listens else "connect"
        return {
            "root_ca_certificate": str(self.folder / _AUTHORITY),
            f"{side}_certificate": str(self.folder / _CERTIFICATE),
            f"{side}_private_key": str(self.folder / _KEY),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }

    def find_rejection(self, host: str, port: int, *, timeout_s: float = 1.0) -> str | None:
        """Return why a rig refuses this holder, as reported by TLS; None if it accepts.

        Raises:
            OSError: Nothing listens there, or there is no answer in time.
        """
        context = ssl.create_default_context(cafile=self.folder / _AUTHORITY)
        context.verify_flags &= ~getattr(ssl, "VERIFY_X509_STRICT", 0)
        context.load_cert_chain(self.folder / _CERTIFICATE, self.folder / _KEY)
        with socket.create_connection((host, port), timeout=timeout_s) as plain:
            greeted = False
            try:
                with context.wrap_socket(plain, server_hostname=host) as link:
                    greeted = True
                    # The other side's opinion of our certificate arrives only now; otherwise it waits for us to send.
                    link.recv(1)
            except (TimeoutError, ConnectionError):
                return None if greeted else "no TLS is spoken there"
            except ssl.SSLError as error:
                error_text = getattr(error, "verify_message", None) or error.reason or str(error)
                if error_text == "certificate has expired":
                    return f"the rig's certificate expired on {_read_expiry(host, port, context):%Y-%m-%d %H:%M} UTC"
                return f"{error_text.replace('_', ' ').lower()} (keys of another rig, or expired?)"
        return None


def _read_expiry(host: str, port: int, context: ssl.SSLContext) -> datetime:
    """Return the expiry of the certificate that a server shows, valid or not."""
    from cryptography import x509

    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with socket.create_connection((host, port), timeout=1.0) as plain, context.wrap_socket(plain) as link:
        return x509.load_der_x509_certificate(link.getpeercert(binary_form=True) or b"").not_valid_after_utc


def read_holder(folder: Path | str, *, server: bool) -> Holder:
    """Return the holder of a folder; from a folder created by `create_keys`, a server uses its own.

    Raises:
        InputError: The folder is not of that kind, its certificate has expired, or its list is malformed.
    """
    from cryptography import x509
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    holder_folder = Path(folder).expanduser().absolute()
    if server and (holder_folder / SERVER).is_dir():
        holder_folder /= SERVER
    kind = "the rig" if server else f"one role ({', '.join(ROLES)})"
    must = f"a folder with the keys of {kind}, as made by: rig keys init"
    try:
        certificate = x509.load_pem_x509_certificate(read_file(holder_folder / _CERTIFICATE, _MAX_BYTES))
        usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        name = str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        is_complete = all((holder_folder / file).is_file() for file in (_AUTHORITY, _KEY))
    except (OSError, ValueError, IndexError, x509.ExtensionNotFound):
        raise InputError("--tls", must, str(folder)) from None
    required_usage = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
    if not is_complete or required_usage not in usage:
        raise InputError("--tls", must, str(folder))
    key = holder_folder / _KEY
    if os.name == "posix" and key.stat().st_mode & 0o077:
        raise InputError("--tls", f"a folder whose key is private to its owner (chmod 600 {key})", Words("another"))
    allowed = tuple(_read_allowed(holder_folder)) if server else ()
    holder = Holder(holder_folder, name, certificate.not_valid_after_utc, allowed)
    if holder.expires <= datetime.now(UTC):
        must = "a certificate that is valid (rig keys init makes new ones)"
        raise InputError("--tls", must, Words(holder.describe_expiry()))
    return holder


def _read_allowed(server: Path) -> list[str]:
    """Return the common names that a rig admits; without a list, those of all roles."""
    if not (server / _ALLOWED).exists():
        return list(ROLE_NAMES)
    names = read_file(server / _ALLOWED, _MAX_BYTES).decode(errors="replace").split()
    if wrong := [name for name in names if not _NAME.fullmatch(name)]:
        raise InputError(str(server / _ALLOWED), "a list of certificates' names", wrong[0])
    return names


def _write_allowed(server: Path, names: Sequence[str]) -> None:
    write_file(server / _ALLOWED, "".join(f"{name}\n" for name in names))


def _check_replaceable(folder: Path, *, force: bool) -> None:
    """Raise an error unless a folder is new or empty or, with `force`, holds nothing but keys."""
    existing = {path.relative_to(folder) for path in folder.rglob("*")} if folder.is_dir() else {None}
    devices = [get_device(name) for name in _read_allowed(folder / SERVER)] if force else []
    holders = [*HOLDERS, AUTHORITY, *filter(None, devices)]
    ours = {Path(holder, file) for holder in holders for file in ("", *_FILES)} | {Path(SERVER, _ALLOWED)}
    if existing and not (force and existing <= ours):
        must = "a new folder (--force replaces one that holds nothing but keys of a rig)"
        raise InputError("DIR", must, Words(f"{folder}, which exists"))


def create_keys(
    folder: Path,
    *,
    hosts: Sequence[str] = (),
    days: float = 365,
    truth: Collection[str] = (),
    keep_authority: bool = False,
    force: bool = False,
) -> list[str]:
    """Create an authority and a folder for each holder, all or nothing.

    Args:
        folder: New or empty folder.
        hosts: Names and addresses of the rig's computer; localhost and 127.0.0.1 are always included.
        days: Validity of the certificates.
        truth: Roles that may also read the truth.
        keep_authority: Keep the authority's key, for `add_device`.
        force: Replace a folder that this function created, complete or not.

    Returns:
        The names and addresses in the rig's certificate.

    Raises:
        InputError: A name is invalid, or the folder holds other files.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID as Usage

    names = list(dict.fromkeys([*hosts, "localhost", "127.0.0.1"]))
    subjects = [build_subject(name) for name in names]
    if unknown := sorted(set(truth) - set(ROLES)):
        raise InputError("--truth", f"one of {', '.join(ROLES)}", unknown[0])
    if folder.exists() or folder.is_symlink():
        _check_replaceable(folder, force=force)
    try:
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.absolute().parent))
    except OSError as error:
        raise InputError("DIR", "in a folder that can be written", Words(f"{folder} ({error.strerror})")) from None
    try:
        signing = ec.generate_private_key(ec.SECP256R1())
        issue = CertificateIssuer(signing, timedelta(days=days))
        authority = issue.certificate(SIGNER, signing, None, [])
        granted = {role: role + WITH_TRUTH if role in truth else role for role in ROLES}
        for holder in HOLDERS:
            key = ec.generate_private_key(ec.SECP256R1())
            is_rig = holder == SERVER
            usage, valid_for = (Usage.SERVER_AUTH, subjects) if is_rig else (Usage.CLIENT_AUTH, [x509.DNSName(holder)])
            certificate = issue.certificate(granted.get(holder, names[0]), key, usage, valid_for)
            write_holder(part / holder, authority, certificate, key)
        _write_allowed(part / SERVER, list(granted.values()))
        if keep_authority:
            write_holder(part / AUTHORITY, authority, authority, signing)
        replaced = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=part.parent))
        if folder.exists():
            folder.rename(replaced)
        part.rename(folder)
        shutil.rmtree(replaced)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return names


def add_device(folder: Path, device: str, role: str, *, truth: bool = False, days: float = 365) -> datetime:
    """Create a device's folder, and admit its certificate, which is bound to its name.

    Args:
        folder: Folder of `create_keys` with the authority's key.
        device: Name of the device.
        role: Its role.
        truth: It may also read the truth.
        days: Validity of the certificate, at most that of the authority.

    Returns:
        Expiry of the certificate.

    Raises:
        InputError: A name is invalid or in use, or the folder has no authority that is valid.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import load_pem_private_key
    from cryptography.x509.oid import ExtendedKeyUsageOID as Usage

    if role not in ROLES:
        raise InputError("--role", f"one of {', '.join(ROLES)}", role)
    names = _read_allowed(folder / SERVER)
    if not re.fullmatch(DEVICE_NAME, device) or device in (*HOLDERS, AUTHORITY) or (folder / device).exists():
        raise InputError("NAME", "a new name of letters, digits and hyphens, not that of a role or a folder", device)
    try:
        authority = x509.load_pem_x509_certificate(read_file(folder / AUTHORITY / _CERTIFICATE, _MAX_BYTES))
        signing: Any = load_pem_private_key(read_file(folder / AUTHORITY / _KEY, _MAX_BYTES), None)
    except (OSError, ValueError, TypeError):
        raise InputError("DIR", "a folder made by: rig keys init --keep-authority", str(folder)) from None
    valid = min(timedelta(days=days), authority.not_valid_after_utc - datetime.now(UTC))
    if valid <= timedelta():
        expired = Words(f"one that expired on {authority.not_valid_after_utc:%Y-%m-%d %H:%M} UTC")
        raise InputError("DIR", "a folder with an authority that is valid (rig keys init makes a new one)", expired)
    key = ec.generate_private_key(ec.SECP256R1())
    name = f"{role}{WITH_TRUTH if truth else ''}@{device}.{secrets.token_hex(4)}"
    issue = CertificateIssuer(signing, valid)
    certificate = issue.certificate(name, key, Usage.CLIENT_AUTH, [x509.DNSName(device)])
    write_holder(folder / device, authority, certificate, key)
    _write_allowed(folder / SERVER, [*names, name])
    return certificate.not_valid_after_utc


def remove_holder(folder: Path, holder: str) -> None:
    """Withdraw the certificate of a device or a role, and remove its folder.

    Raises:
        InputError: No certificate of that name is admitted.
    """
    names = _read_allowed(folder / SERVER) if (folder / SERVER).is_dir() else []
    left = [name for name in names if holder not in (get_device(name), name.removesuffix(WITH_TRUTH))]
    if left == names:
        raise InputError("NAME", f"a device or role that {folder} admits", holder)
    _write_allowed(folder / SERVER, left)
    for file in _FILES:
        (folder / holder / file).unlink(missing_ok=True)
    with suppress(OSError):
        (folder / holder).rmdir()  # keeps a folder that holds other files


class CertificateIssuer(NamedTuple):
    """The signing key and the validity of its certificates."""

    signing: EllipticCurvePrivateKey
    valid: timedelta

    def certificate(
        self,
        name: str,
        key: EllipticCurvePrivateKey,
        usage: x509.ObjectIdentifier | None,
        subjects: Sequence[x509.GeneralName],
    ) -> x509.Certificate:
        """Return a certificate for a key; without a usage, the authority's own."""
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.x509.oid import NameOID

        now = datetime.now(UTC)
        subject_name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        issuer = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, SIGNER)])
        builder = (
            x509.CertificateBuilder(issuer, subject_name, key.public_key(), x509.random_serial_number())
            .not_valid_before(now - _SKEW)
            .not_valid_after(now + self.valid)
            .add_extension(x509.BasicConstraints(ca=usage is None, path_length=None), critical=True)
        )
        if usage is not None:
            builder = builder.add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
            builder = builder.add_extension(x509.SubjectAlternativeName(subjects), critical=False)
        return builder.sign(self.signing, hashes.SHA256())


def build_subject(name: str) -> x509.GeneralName:
    """Return a computer's name or address in the form of a certificate."""
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        if _HOST.fullmatch(name) is None:
            raise InputError("--host", "the name or address of the rig's computer", name) from None
        return x509.DNSName(name)


def write_holder(
    folder: Path, authority: x509.Certificate, certificate: x509.Certificate, key: EllipticCurvePrivateKey
) -> None:
    """Write a holder's folder; only its owner can read the key."""
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    folder.mkdir(mode=0o700)
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (folder / _KEY).touch(mode=0o600)
    for name, data in (
        (_KEY, private),
        (_CERTIFICATE, certificate.public_bytes(Encoding.PEM)),
        (_AUTHORITY, authority.public_bytes(Encoding.PEM)),
    ):
        (folder / name).write_bytes(data)
