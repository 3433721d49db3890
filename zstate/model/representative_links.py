"""The links of a robot whose poses show most of it."""

from __future__ import annotations

from collections import Counter

from zstate.model.robot import RobotModel


def representative_links(model: RobotModel, count: int = 3) -> tuple[str, ...]:
    """At most ``count`` moving links: the ends of the longest branches, and links inside the longest.

    Several ends on one link, such as fingers, count as that link. Empty when nothing moves.
    """
    inbound = {joint.child: joint for joint in model.joints}
    paths: dict[str, list[str]] = {}  # for each link that moves in the root, the moving links above it
    for link in model.links:
        path: list[str] = []
        joint = inbound.get(link)
        while joint is not None:
            path.append(joint.child)
            joint = inbound.get(joint.parent)
        while path and inbound[path[-1]].type == "fixed":
            path.pop()
        if path:
            paths[link] = path[::-1]
    children = Counter(joint.parent for joint in model.joints)
    ends: dict[str, None] = {}
    for leaf in (link for link in paths if not children[link]):
        parent = inbound[leaf].parent
        ends[parent if children[parent] > 1 and parent in paths else leaf] = None
    branches: list[str] = []
    for end in sorted(ends, key=lambda link: -len(paths[link])):
        # A separate branch shares at most half of its links with each longer one.
        if all(2 * len(set(paths[end]) & set(paths[other])) <= len(paths[end]) for other in branches):
            branches.append(end)
    if not branches:
        return ()
    longest = paths[branches[0]]
    del branches[count - 1 :]
    inner = count - len(branches)
    between = [longest[len(longest) * part // (inner + 1)] for part in range(inner, 0, -1)]
    return tuple(dict.fromkeys([*branches, *between]))
