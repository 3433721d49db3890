"""Cyclone DDS in Python: the messages of ROS 2, without ROS."""

from __future__ import annotations

import functools
from collections.abc import Mapping

from bench.job import Job
from bench.subjects.subject import Roles, Subject, environment_path, venv_python, versions_there
from bench.subjects.tf_messages import DOMAIN_VARIABLE, NO_STATE_PUBLISHER, free_domain

# Loopback only; enough participants for any run.
CONFIG = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>
    <Peers><Peer Address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""


@functools.cache
def _versions() -> dict[str, str]:
    return versions_there(venv_python("cyclone"), "cyclonedds")


def _environment(job: Job) -> Mapping[str, str]:
    return {DOMAIN_VARIABLE: str(free_domain(job.ports)), "CYCLONEDDS_URI": CONFIG}


def _load() -> Roles:
    from bench.subjects import cyclone_roles as roles  # noqa: PLC0415 - imported late, as the protocol requires

    return roles.Writer, roles.Reader


SUBJECTS = (
    Subject(
        "cyclone",
        "Cyclone DDS messages, Python",
        (
            "Eclipse Cyclone DDS from PyPI with ROS 2's IDL of the messages; unicast on loopback, peers "
            "named; UDP, for the wheel has no shared memory",
            "the writer publishes JointState (from one object for all samples, serialized by cyclonedds; "
            "reliable, keep last 10) and TFMessage (reliable, keep last 100), static edges transient local; "
            "XCDR1",
            *NO_STATE_PUBLISHER,
            "reader: a listener's on_data_available, in Cyclone's own receiving thread, takes the samples; "
            "it does not subscribe to the joint states",
        ),
        (
            f"python -m venv {environment_path('cyclone')}",
            f"{environment_path('cyclone')}/bin/python -m pip install cyclonedds==11.0.1",
        ),
        python=lambda: venv_python("cyclone"),
        versions=_versions,
        load=_load,
        environment=_environment,
    ),
)
