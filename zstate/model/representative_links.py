"""Which frames of a robot tell most in a few lines."""

from __future__ import annotations

from zstate.model.robot import RobotModel


def representative_links(model: RobotModel, count: int = 3) -> tuple[str, ...]:
    """At most ``count`` moving links: the ends of the longest branches, and links inside the longest.

    Several ends on one link, such as fingers, count as that link. Empty when nothing moves.
    """
    paths = _moving_paths(model)
    chosen: list[str] = []
    for end in sorted(_ends(model, list(paths)), key=lambda link: -len(paths[link])):
        # A branch is another one if at least half of it is its own.
        if all(2 * len(set(paths[end]) & set(paths[other])) <= len(paths[end]) for other in chosen):
            chosen.append(end)
    if not chosen:
        return ()
    branches, longest = chosen[: count - 1], paths[chosen[0]]
    inner = count - len(branches)
    between = [longest[len(longest) * part // (inner + 1)] for part in range(inner, 0, -1)]
    return tuple(dict.fromkeys([*branches, *between]))


def _moving_paths(model: RobotModel) -> dict[str, list[str]]:
    """For each link that moves in the root, the links on the way to it that do."""
    paths: dict[str, list[str]] = {}
    inbound = {joint.child: joint for joint in model.joints}
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
    return paths


def _ends(model: RobotModel, moving: list[str]) -> list[str]:
    parents = {joint.child: joint.parent for joint in model.joints}
    children = {link: [child for child, parent in parents.items() if parent == link] for link in model.links}
    gathered: list[str] = []
    for leaf in (link for link in moving if not children[link]):
        parent = parents[leaf]
        gathered.append(parent if len(children[parent]) > 1 and parent in moving else leaf)
    return list(dict.fromkeys(gathered))
