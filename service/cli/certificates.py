"""`thirdhand certificates`: a new authority with a certificate for each role, and further
certificates by the same authority.
"""

from __future__ import annotations

import argparse
import datetime
import ipaddress
import os
import socket
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from service.cli.usage import UsageError
from service.client import AUTHORITY, CERTIFICATE, KEY
from service.contract.explain import ExplainedError, in_words
from service.contract.roles import DAEMON, MOST_OF_A_ROLE, ROLES, SERVERS, names
from service.settings.whole_file import whole

AUTHORITY_KEY = "authority.key"
KEPT_EXTENSIONS = (x509.ExtendedKeyUsage, x509.AuthorityKeyIdentifier, x509.SubjectAlternativeName)  # of a renewed one
GIVEN = "given.txt"  # a file with the names of all certificates that were made
CLOCKS_DIFFER = datetime.timedelta(days=1)  # certificates are valid this long before now, for clocks that are behind


def certificates(args: argparse.Namespace) -> int:
    """Write the certificates and return exit code 0."""
    if args.name and not args.role:
        raise UsageError(f"--name {args.name}: --role needed with it")
    folder: Path = args.folder
    hosts = list(dict.fromkeys(["localhost", "127.0.0.1", "::1", socket.gethostname(), *(args.host or [])]))
    for host in hosts:
        try:
            _host(host or " ")
        except ValueError:
            raise UsageError(f"--host {host!r}: a name in plain letters, or an address, needed") from None
    if args.renew:
        if args.role or args.host:
            raise UsageError("--renew keeps names, roles and hosts: without --role and --host")
        return _renew(folder, args.days)
    if not args.role and folder.exists() and any(folder.iterdir()):
        raise ExplainedError(
            f"{folder} is not empty, and certificates are not overwritten: a new or empty folder needed; "
            "--role makes one more certificate by the authority in a folder"
        )
    with whole(folder) as part:  # a folder that exists is written directly
        if args.role:
            authority, key = _authority_in(folder)
            made = [_free_name(folder, args.role, args.name)]
            about = [f"{made[0]}, of role {args.role}"]
        else:
            authority, key = _new_authority(part, args.days)
            made = [DAEMON, *ROLES]
            about = [f"for the daemon, as {', '.join(hosts)}", *(f"its holder {role.about}" for role in ROLES.values())]
        ends = [_write(part / name, authority, key, hosts=hosts, days=args.days) for name in made]
    for name, what, until in zip(made, about, ends, strict=True):
        print(f"{folder / name}: {what}; valid until {until:%Y-%m-%d}")
    print(f"{folder / AUTHORITY_KEY}: this key makes further certificates; keep it in a safe place")
    return 0


def _new_authority(folder: Path, days: int) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """A new authority, whose key is written to the folder."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("thirdhand authority")
    authority = _builder(name, name, key.public_key(), _days_from_now(days), signs=True).sign(key, hashes.SHA256())
    _save(folder / AUTHORITY_KEY, _pem(key))
    return authority, key


def _renew(folder: Path, days: int) -> int:
    """Renew the authority and every certificate in its folder, with their names, hosts and keys;
    return exit code 0.
    """
    authority, key = _authority_in(folder, expired=True)
    until, own = _days_from_now(days), authority.subject
    renewed = _builder(own, own, key.public_key(), until, signs=True).sign(key, hashes.SHA256())
    paths = sorted(folder.glob(f"*/{CERTIFICATE}"))
    known = {path: x509.load_pem_x509_certificate(path.read_bytes()) for path in paths}
    for path, one in known.items():
        try:
            one.verify_directly_issued_by(authority)
        except (InvalidSignature, ValueError, TypeError):
            raise ExplainedError(f"{path} is not by the authority in {folder}: nothing was renewed") from None
    for path, one in known.items():
        builder = _builder(one.subject, own, one.public_key(), until, signs=False)  # type: ignore[arg-type]
        for extension in one.extensions:
            if isinstance(extension.value, KEPT_EXTENSIONS):
                builder = builder.add_extension(extension.value, critical=extension.critical)
        _replace(path, _public(builder.sign(key, hashes.SHA256())))
        _replace(path.with_name(AUTHORITY), _public(renewed))
        print(f"{path.parent}: renewed; valid until {until:%Y-%m-%d}")
    print(
        f"Copy {CERTIFICATE} and {AUTHORITY} to the machine of each role, beside its {KEY}, which is unchanged, and "
        f"start its program again. To renew one whose folder is elsewhere, copy its {CERTIFICATE} back first."
    )
    return 0


def _authority_in(folder: Path, *, expired: bool = False) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """The authority that this command made in a folder before; also an `expired` one, or else it is
    an error. Raises ExplainedError.
    """
    try:
        key = serialization.load_pem_private_key((folder / AUTHORITY_KEY).read_bytes(), None)
        beside = next(iter(sorted(folder.glob(f"*/{AUTHORITY}"))), folder / DAEMON / AUTHORITY)
        authority = x509.load_pem_x509_certificate(beside.read_bytes())
    except (OSError, ValueError) as error:
        raise ExplainedError(
            f"no authority in {folder} ({in_words(error)}): {AUTHORITY_KEY} and {DAEMON}/{AUTHORITY} needed, "
            f"as `thirdhand certificates {folder}` made them"
        ) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != authority.public_key():
        raise ExplainedError(f"{folder / AUTHORITY_KEY} is not the key of {beside}")
    if authority.not_valid_after_utc <= now() and not expired:
        raise ExplainedError(
            f"the authority in {folder} expired on {authority.not_valid_after_utc:%Y-%m-%d}: renew all by --renew"
        )
    return authority, key


def _free_name(folder: Path, role: str, wanted: str | None) -> str:
    """A name that no certificate of the role had before, so that a revoked name remains revoked."""
    taken = {path.name for path in folder.iterdir()}
    if role != DAEMON and (folder / GIVEN).exists():  # it lists certificates that were moved to their machines too
        taken |= set((folder / GIVEN).read_text(encoding="utf-8").split())
    if wanted is not None and wanted not in names(role):
        raise UsageError(f"--name {wanted}: {role} with a number needed, {names(role)[1]} to {names(role)[-1]}")
    if wanted in taken:
        raise ExplainedError(f"{folder / str(wanted)} was made before: a new name needed")
    free = wanted or next((name for name in names(role) if name not in taken), None)
    if free is None:
        raise ExplainedError(f"{folder} has {MOST_OF_A_ROLE} certificates of role {role}; the daemon accepts no more")
    return free


def _write(
    folder: Path, authority: x509.Certificate, key: ec.EllipticCurvePrivateKey, *, hosts: list[str], days: int
) -> datetime.datetime:
    """Write a certificate, its key and the authority's certificate to a private folder with the
    name of its holder, and return the end of its validity.

    A certificate of a daemon, router or headset's page is valid for `hosts`.
    """
    record = os.open(folder.parent / GIVEN, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    with open(record, "a", encoding="utf-8") as given:
        print(folder.name, file=given)
    own = ec.generate_private_key(ec.SECP256R1())
    serves = any(folder.name in names(role) for role in SERVERS)
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * serves
    until = min(_days_from_now(days), authority.not_valid_after_utc)
    builder = (
        _builder(_name(folder.name), authority.subject, own.public_key(), until, signs=False)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key()), critical=False)
    )
    if serves:
        builder = builder.add_extension(x509.SubjectAlternativeName([_host(host) for host in hosts]), critical=False)
    with whole(folder) as part:
        _save(part / KEY, _pem(own))
        _save(part / CERTIFICATE, _public(builder.sign(key, hashes.SHA256())))
        _save(part / AUTHORITY, _public(authority))
    return until


def now() -> datetime.datetime:
    """The present time in UTC."""
    return datetime.datetime.now(datetime.UTC)


def _days_from_now(days: int) -> datetime.datetime:
    return now() + datetime.timedelta(days=days)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, until: datetime.datetime, *, signs: bool
) -> x509.CertificateBuilder:
    """The common content of certificates; `signs` for the holder that signs others."""
    usage = x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now() - CLOCKS_DIFFER)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.BasicConstraints(ca=signs, path_length=0 if signs else None), critical=True)
        .add_extension(usage, critical=True)
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _public(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _save(path: Path, data: bytes) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)


def _replace(path: Path, data: bytes) -> None:
    """Replace a file at once, so that a program which starts now reads the old or the new one."""
    with whole(path) as part:
        _save(part, data)
