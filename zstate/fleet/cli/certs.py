"""zstate certs: a test certificate authority, and certificates of robots, routers and users."""

from __future__ import annotations

import click

from zstate.cli.output.console import print_status, print_wrapped


@click.command("certs")
@click.argument("folder", metavar="DIR", type=click.Path(file_okay=False))
@click.option("--identity", "identities", multiple=True, metavar="NAME", help="A client; may be repeated.")
@click.option(
    "--server",
    "servers",
    multiple=True,
    metavar="NAME",
    help="An identity that listens, as `router` always does; may be repeated.",
)
@click.option(
    "--host",
    "hosts",
    multiple=True,
    metavar="HOST",
    help="Address of the servers, in addition to localhost, 127.0.0.1 and ::1; may be repeated.",
)
@click.option("--days", type=click.IntRange(min=1), default=365, show_default=True, help="Validity in days.")
def certs_command(
    folder: str, identities: tuple[str, ...], servers: tuple[str, ...], hosts: tuple[str, ...], days: int
) -> None:
    """Make certificates for tests: an authority in DIR, and an identity for each NAME.

    A second call adds identities to the existing authority. Files are never overwritten. Only the
    identities of --server, and one called router, may listen. Clients check the host name of a server, so
    pass the addresses of a router as --host. Other identities only connect and cannot pose as a router; a
    peer that listens is a --server.

    \b
    zstate certs fleet --identity router --host 192.168.1.10
    zstate certs fleet --identity robot1 --identity viewer
    zstate router --listen tls/0.0.0.0:7447 --certs fleet --identity router
    zstate ls --connect tls/192.168.1.10:7447 --certs fleet --identity viewer
    zstate certs fleet --server peer1 --server peer2   # for direct links, without a router
    """
    from zstate.fleet.certificates import issue_identities
    from zstate.net.security.credentials import AUTHORITY, CertificateFiles

    authority = CertificateFiles.for_name(folder, AUTHORITY)
    names = (*identities, *(name for name in servers if name not in identities))
    if not names:
        raise click.UsageError("no identity is named; give --identity NAME, or --server NAME for a listener")
    may_listen = {"router", *servers}.intersection(names)
    if hosts and not may_listen:
        raise click.UsageError("--host needs an identity that listens: --server NAME or --identity router")
    issued = issue_identities(folder, names, hosts=hosts, servers=may_listen, days=days)
    for name, files in issued.items():
        print_wrapped(f"{name}: {files.certificate} and {files.key}, for {days} days")
    print_status(
        f"These are for tests: with {authority.key} anyone can issue any identity. In production keep it off "
        "every robot and router, or better, let your own authority sign (common name = identity, for TLS "
        f"servers and clients). A machine needs {authority.certificate}, its own .pem and its own .key, and "
        "new ones before these expire."
    )
