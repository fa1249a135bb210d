"""Network settings of a cell: endpoints, certificates, ROS 2 domain and controllers."""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated

import msgspec

from thirdhand.contract import ros2
from thirdhand.contract.channels import ENDPOINT, lacking
from thirdhand.contract.roles import DAEMON, ROLES, names

Domain = Annotated[
    Annotated[int, msgspec.Meta(ge=0, le=ros2.LAST_DOMAIN)] | None,
    msgspec.Meta(extra={"accepted": f"a whole number from 0 to {ros2.LAST_DOMAIN}"}),
]


_TOPIC = "(/[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*)"
Topic = Annotated[
    str,
    msgspec.Meta(pattern=rf"\A{_TOPIC}*\Z", extra={"accepted": "a topic's full name, /like/this,"}),
]
FrameSource = Annotated[
    str,
    msgspec.Meta(
        pattern=rf"\A({_TOPIC}+:[\w.-][\w./-]{{0,63}})?\Z",
        extra={"accepted": "a topic and a frame, like /tf:left_wrist,"},
    ),
]
HandSources = Annotated[
    tuple[FrameSource, FrameSource],
    msgspec.Meta(
        extra={"accepted": 'both hands\' frames, like ["/tf:left_wrist", "/tf:right_wrist"],'}
    ),
]


def is_local(endpoint: str) -> bool:
    """True if only processes of this machine can reach a Zenoh endpoint."""
    protocol, _, address = endpoint.partition("/")
    host = re.sub(r"(:\w*)?([?#].*)?$", "", address).strip("[]")
    try:
        return (
            protocol == "unixsock-stream"
            or host == "localhost"
            or ipaddress.ip_address(host).is_loopback
        )
    except ValueError:
        return False


class Network(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Zenoh endpoints. The service announces nothing by multicast and connects to named peers only.

    With a certificate all endpoints are TLS, and each role has its own rights.
    """

    # endpoints on which the daemon listens; port 0: a free one
    listen: tuple[str, ...] = (ENDPOINT,)
    connect: tuple[str, ...] = ()  # endpoints of routers or peers to connect to
    # the folder with the daemon's certificate.pem, key.pem and authority.pem; empty: none
    certificate: str = ""
    # names of certificates, like tracker-2, that are no longer accepted
    revoked: tuple[str, ...] = ()
    # file with Zenoh's own settings, where the service sets none; empty: none
    zenoh_config: str = ""
    # domain of ROS 2 nodes that see the cell through rmw_zenoh; None: none
    ros2_domain: Domain = None
    # accept a network without TLS: everyone on it, or at its router, can move the arm
    allow_insecure: bool = False

    @property
    def reached_at(self) -> tuple[str, ...]:
        """The endpoints at which programs of this machine reach the daemon."""
        listening = [
            re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", endpoint) for endpoint in self.listen
        ]
        return (
            tuple(endpoint for endpoint in listening if not re.search(r":0([?#]|$)", endpoint))
            or self.connect
        )

    def __post_init__(self) -> None:
        for name, endpoints in (("listen", self.listen), ("connect", self.connect)):
            for i, endpoint in enumerate(endpoints):
                self._check_endpoint(f"{name}[{i}]", endpoint)
        if self.revoked and not self.certificate:
            raise ValueError(
                "$.network.revoked: given without $.network.certificate, without which no client "
                "has a certificate"
            )
        for i, name in enumerate(self.revoked):
            if not any(name in names(role) for role in (*ROLES, DAEMON)):
                raise ValueError(
                    f"$.network.revoked[{i}]: {name!r} given; a certificate's name needed: one of "
                    f"{', '.join((*ROLES, DAEMON))}, or one of these with a number, like "
                    f"{names('tracker')[1]}"
                )

    def _check_endpoint(self, name: str, endpoint: str) -> None:
        """Raise ValueError for an endpoint that is not valid, or not safe."""
        is_tls = endpoint.startswith("tls/")
        if lacks := lacking(endpoint):
            raise ValueError(f"$.network.{name}: {lacks}")
        if self.certificate and not is_tls:
            raise ValueError(
                f"$.network.{name}: {endpoint} given; with a certificate tls/... needed"
            )
        if is_tls and not self.certificate:
            raise ValueError(
                f"$.network.certificate: none given; for {endpoint} the folder of one needed"
            )
        if not (self.certificate or self.allow_insecure or is_local(endpoint)):
            raise ValueError(
                f"$.network.{name}: {endpoint} given; other machines could move the arm: an "
                "address like 127.0.0.1, or certificate = ... with tls/..., or else "
                "allow_insecure = true needed"
            )


class Ros2(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Topics in the domain `network.ros2_domain`: of the arm's controllers in ros2_control, of RViz
    and rqt, and of trackers that publish transforms. Each setting is the full name of a topic,
    with `:` and a frame for transforms; empty: none.
    """

    position_commands: Topic = ""  # forward_command_controller for positions: /<its name>/commands
    trajectory: Topic = ""  # joint_trajectory_controller: /<its name>/joint_trajectory
    # joint_state_broadcaster: /joint_states, received in addition to the cell's own
    joint_states: Topic = ""
    # joints in the order of the controller's parameter `joints`; empty: as `joints.names`
    joints: tuple[str, ...] = ()
    # left and right hand, as frames in a TFMessage; their parent is the tracker's frame
    hands: HandSources = ("", "")
    tool: FrameSource = ""  # the tool in demonstrations, as such a frame
    # /tf: setpoint, target and hands ten times a second; fixed frames on the same name with _static
    tf: Topic = ""
    # /robot_description: the URDF, latched, if no other node has it; `tf` has its links
    robot_description: Topic = ""
    diagnostics: Topic = ""  # /diagnostics: mode, reason and lateness each second

    def __post_init__(self) -> None:
        sources = {
            "$.ros2.hands[0]": self.hands[0],
            "$.ros2.hands[1]": self.hands[1],
            "$.ros2.tool": self.tool,
        }
        first_of: dict[str, str] = {}
        for path, source in sources.items():
            topic, _, frame = source.partition(":")
            if topic.endswith("_static"):
                raise ValueError(
                    f"{path}: {source!r} given; a topic of frames that move needed, like /tf"
                )
            if source and topic == self.tf and frame in ros2.OWN_FRAMES:
                raise ValueError(
                    f"{path}: {source!r} given, which this cell publishes itself on $.ros2.tf; a "
                    "tracker's frame needed"
                )
            if source and (first := first_of.setdefault(source, path)) != path:
                raise ValueError(
                    f"{path}: {source!r} given; another frame than that of {first} needed"
                )
