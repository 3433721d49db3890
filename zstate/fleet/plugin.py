"""What fleet brings: the commands for routers, their access control, and certificates."""

from zstate.plugins import Command, Plugin

PLUGIN = Plugin(
    "fleet",
    commands={
        "router": Command("zstate.fleet.cli.router:router_command", "Run", "A Zenoh router."),
        "acl": Command(
            "zstate.fleet.cli.acl:acl_command", "Run", "Access control for the configuration of a router."
        ),
        "certs": Command(
            "zstate.fleet.cli.certs:certs_command",
            "Run",
            "Certificates for tests: an authority and identities.",
        ),
    },
    synonyms={
        "rmw_zenohd": "router --ros2",
        "zenohd": "router",
    },
)
