"""`thirdhand certificates`: a small authority of one's own, and a certificate for each role."""

from __future__ import annotations

import argparse
import datetime
import ipaddress
import os
import socket
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from service.cli.usage import UsageError
from service.client import AUTHORITY, CERTIFICATE, KEY
from service.contract.explain import ExplainedError
from service.shell.roles import DAEMON, ROLES

DAYS = 3650
CLOCKS_DIFFER = datetime.timedelta(days=1)


def certificates(args: argparse.Namespace) -> int:
    """Exit code 0 once all are written."""
    if not 1 <= args.days <= 10 * DAYS:
        raise UsageError(f"--days {args.days}: 1 to {10 * DAYS} accepted")
    folder: Path = args.folder
    if folder.exists() and any(folder.iterdir()):
        raise ExplainedError(f"{folder} is not empty: a new or empty folder needed, certificates are not written over")
    hosts = list(dict.fromkeys(["localhost", "127.0.0.1", "::1", socket.gethostname(), *(args.host or [])]))
    write(folder, hosts=hosts, days=args.days)
    print(f"{folder / DAEMON}: for the daemon, as {', '.join(hosts)}")
    for name, role in ROLES.items():
        print(f"{folder / name}: its holder {role.about}")
    print(f"{folder / 'authority.key'}: who has it can make more; keep it apart")
    return 0


def write(folder: Path, *, hosts: list[str], days: int) -> None:
    """An authority, and for the daemon (which clients reach as `hosts`) and each role a folder with
    certificate, key and the authority's certificate, all private to their user.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("thirdhand authority")
    authority = (
        _builder(name, name, key, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    _save(folder / "authority.key", _pem(key))
    for role in (DAEMON, *ROLES):
        own = ec.generate_private_key(ec.SECP256R1())
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * (role == DAEMON)
        builder = (
            _builder(_name(role), name, own, days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key()), critical=False)
        )
        if role == DAEMON:
            builder = builder.add_extension(
                x509.SubjectAlternativeName([_host(host) for host in hosts]), critical=False
            )
        _save(folder / role / KEY, _pem(own))
        _save(folder / role / CERTIFICATE, _public(builder.sign(key, hashes.SHA256())))
        _save(folder / role / AUTHORITY, _public(authority))


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCKS_DIFFER)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
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
