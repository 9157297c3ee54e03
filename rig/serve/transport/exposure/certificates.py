"""Certificates of an exposed rig: one authority, and a folder for each holder.

The authority's key signs the certificates and is discarded: no certificate can be added later. A holder's folder is
complete (`authority.pem`, `certificate.pem`, `key.pem`), so that it can be copied to the client's computer.
"""

from __future__ import annotations

import ipaddress
import os
import re
import shutil
import socket
import ssl
import tempfile
from collections.abc import Collection, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.base.errors import InputError, Words
from rig.serve.transport.exposure.access import ROLES, WITH_TRUTH

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

SERVER, SIGNER = "server", "rig authority"
HOLDERS = (SERVER, *ROLES)
_AUTHORITY, _CERTIFICATE, _KEY = "authority.pem", "certificate.pem", "key.pem"
_LAYOUT = {Path(holder, file) for holder in HOLDERS for file in ("", _AUTHORITY, _CERTIFICATE, _KEY)}
_SKEW = timedelta(hours=1)
"""Allowed difference between clocks."""
_HOST = re.compile(r"(?=.{1,64}\Z)[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?)*")


class Holder(NamedTuple):
    """A checked folder of one holder.

    Args:
        folder: Its path.
        name: Common name of the certificate; a role, for a client.
        expires: Expiry of the certificate.
    """

    folder: Path
    name: str
    expires: datetime

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
                return f"{error_text.replace('_', ' ').lower()} (keys of another rig, or expired?)"
        return None


def read_holder(folder: Path | str, *, server: bool) -> Holder:
    """Return the holder of a folder; from a folder created by `create_keys`, a server uses its own.

    Raises:
        InputError: The folder is not of that kind, or its certificate has expired.
    """
    from cryptography import x509
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    holder_folder = Path(folder).expanduser().absolute()
    if server and (holder_folder / SERVER).is_dir():
        holder_folder /= SERVER
    kind = "the rig" if server else f"one role ({', '.join(ROLES)})"
    must = f"a folder with the keys of {kind}, as made by: rig keys init"
    try:
        certificate = x509.load_pem_x509_certificate((holder_folder / _CERTIFICATE).read_bytes())
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
    expires = certificate.not_valid_after_utc
    if expires <= datetime.now(UTC):
        raise InputError(
            "--tls", "a certificate that is valid (rig keys init makes new ones)", Words(f"{holder_folder}, expired")
        )
    return Holder(holder_folder, name, expires)


def create_keys(
    folder: Path,
    *,
    hosts: Sequence[str] = (),
    days: float = 365,
    truth: Collection[str] = (),
    force: bool = False,
) -> list[str]:
    """Create an authority and a folder for each holder, all or nothing.

    Args:
        folder: New or empty folder.
        hosts: Names and addresses of the rig's computer; localhost and 127.0.0.1 are always included.
        days: Validity of the certificates.
        truth: Roles that may also read the truth.
        force: Replace a folder that this function created, complete or not.

    Returns:
        The names and addresses in the rig's certificate.

    Raises:
        InputError: A name is invalid, or the folder holds other files.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

    names = list(dict.fromkeys([*hosts, "localhost", "127.0.0.1"]))
    subjects = [build_subject(name) for name in names]
    if unknown := sorted(set(truth) - set(ROLES)):
        raise InputError("--truth", f"one of {', '.join(ROLES)}", unknown[0])
    if folder.exists() or folder.is_symlink():
        existing = {path.relative_to(folder) for path in folder.rglob("*")} if folder.is_dir() else {None}
        if existing and not (force and existing <= _LAYOUT):
            must = "a new folder (--force replaces one that holds nothing but keys of a rig)"
            raise InputError("DIR", must, Words(f"{folder}, which exists"))
    try:
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.absolute().parent))
    except OSError as error:
        raise InputError("DIR", "in a folder that can be written", Words(f"{folder} ({error.strerror})")) from None
    try:
        signing = ec.generate_private_key(ec.SECP256R1())
        issue = CertificateIssuer(signing, timedelta(days=days))
        authority = issue.certificate(SIGNER, signing, None, [])
        for holder in HOLDERS:
            key = ec.generate_private_key(ec.SECP256R1())
            if holder == SERVER:
                certificate = issue.certificate(names[0], key, ExtendedKeyUsageOID.SERVER_AUTH, subjects)
            else:
                name = holder + WITH_TRUTH if holder in truth else holder
                certificate = issue.certificate(name, key, ExtendedKeyUsageOID.CLIENT_AUTH, [x509.DNSName(holder)])
            write_holder(part / holder, authority, certificate, key)
        replaced = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=part.parent))
        if folder.exists():
            folder.rename(replaced)
        part.rename(folder)
        shutil.rmtree(replaced)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return names


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
