"""Visual and collision shapes of the links of a robot.

Materials follow rviz and urdfdom: one defined directly in <robot> wins over one of the same name inside a
link; a reference by name is to the first of that name; and a mesh with materials of its own keeps them, so
that the URDF's colour is for meshes without.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

from zstate._util.format import suggestion_text
from zstate.model.findings import Finding, Findings, quoted
from zstate.model.robot import Pose7, RobotModel, Vector3
from zstate.model.xml import Element, NumberError, read_document, read_number, read_numbers
from zstate.se3 import IDENTITY, quaternion_from_rpy

Role = Literal["visual", "collision"]
Color = tuple[float, float, float, float]

_ROLES: tuple[Role, ...] = ("visual", "collision")
_GEOMETRIES = ("box", "cylinder", "sphere", "mesh")
_SOME_GEOMETRY = '<geometry><box size="0.1 0.1 0.1"/></geometry>'


@dataclass(frozen=True, slots=True)
class Box:
    """A box about its centre; ``size`` along x, y, z [m]."""

    size: Vector3


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder about its centre, along z [m]."""

    radius: float
    length: float


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere about its centre [m]."""

    radius: float


@dataclass(frozen=True, slots=True)
class MeshFile:
    """A mesh file, named as in the URDF; ``scale`` along x, y, z."""

    uri: str
    scale: Vector3 = (1.0, 1.0, 1.0)


Geometry: TypeAlias = Box | Cylinder | Sphere | MeshFile


@dataclass(frozen=True, slots=True)
class Material:
    """Surface of a shape: red, green, blue, opacity in 0..1 (sRGB), and the name of an image."""

    color: Color | None = None
    texture: str | None = None


@dataclass(frozen=True, slots=True)
class Shape:
    """One <visual> or <collision> of a link; ``origin`` is ``link_from_shape`` as pose7."""

    link: str
    role: Role
    origin: Pose7
    geometry: Geometry
    color: Color | None = None
    texture: str | None = None


def read_shapes(model: RobotModel) -> tuple[tuple[Shape, ...], tuple[Finding, ...]]:
    """The shapes that can be drawn, in the order of the URDF, and the faults of the others by line."""
    reader = _Reader(model)
    return tuple(reader.shapes()), reader.findings.sorted()


class _ShapeError(ValueError):
    """The fault of a shape that cannot be drawn, and what to write instead."""

    def __init__(self, element: Element, message: str, fix: str = "") -> None:
        super().__init__(message)
        self.line = element.line
        self.fix = fix


class _Reader:
    def __init__(self, model: RobotModel) -> None:
        self.findings = Findings(model.name)
        self._robot = read_document(model.urdf, model.name).root
        self._links = frozenset(model.links)
        self._materials: dict[str, Material] = {}
        visuals = [visual for link in self._robot.all("link") for visual in link.all("visual")]
        inside = [material for visual in visuals for material in visual.all("material")]
        for element in _defined([*self._robot.all("material"), *inside]):
            name = element.attributes.get("name", "")
            if name and name not in self._materials:
                self._materials[name] = self._material(element)

    def shapes(self) -> Iterator[Shape]:
        for link in self._robot.all("link"):
            name = link.attributes.get("name", "")
            for child in link.children:
                for role in _ROLES:
                    if child.tag == role and name in self._links:
                        yield from self._shape(name, role, child)

    def _shape(self, link: str, role: Role, element: Element) -> Iterator[Shape]:
        origin = IDENTITY
        try:
            for child in element.all("origin")[:1]:
                x, y, z = _numbers(child, "xyz", 3, (0.0, 0.0, 0.0))
                origin = (x, y, z, *quaternion_from_rpy(*_numbers(child, "rpy", 3, (0.0, 0.0, 0.0))))
            geometry = _geometry(element)
        except _ShapeError as fault:
            message = f"link {quoted(link)}: a <{role}> is not drawn: {fault}"
            self.findings.warning(fault.line, message, fault.fix)
            return
        material = self._material_of(link, element)
        yield Shape(link, role, origin, geometry, material.color, material.texture)

    def _material_of(self, link: str, element: Element) -> Material:
        materials = element.all("material")
        if not materials:
            return Material()
        name = materials[0].attributes.get("name", "")
        if name and name in self._materials:
            return self._materials[name]
        if next(_defined(materials[:1]), None) is not None:
            return self._material(materials[0])
        near = suggestion_text(self.findings.did_you_mean(name, self._materials))
        message = f"link {quoted(link)}: the material {quoted(name)} is defined nowhere{near}"
        self.findings.warning(materials[0].line, message, '<color rgba="0.7 0.7 0.7 1"/> inside it')
        return Material()

    def _material(self, element: Element) -> Material:
        files = (texture.attributes.get("filename", "") for texture in element.all("texture"))
        color: Color | None = None
        for child in element.all("color")[:1]:
            try:
                numbers = read_numbers(child.attributes.get("rgba", ""), 4)
            except NumberError as fault:
                name = quoted(element.attributes.get("name", ""))
                self.findings.warning(child.line, f"material {name}: rgba: {fault}", 'rgba="0.7 0.7 0.7 1"')
                break
            red, green, blue, opacity = (min(max(number, 0.0), 1.0) for number in numbers)
            color = (red, green, blue, opacity)
        return Material(color, next(filter(None, files), None))


def _defined(materials: Iterable[Element]) -> Iterator[Element]:
    """The materials that define a color or texture; the others are references by name."""
    return (material for material in materials if material.all("color") or material.all("texture"))


def _geometry(element: Element) -> Geometry:
    shapes = [child for geometry in element.all("geometry") for child in geometry.children]
    if not shapes:
        raise _ShapeError(element, "it has no <geometry> with something inside", _SOME_GEOMETRY)
    shape = shapes[0]
    if shape.tag == "box":
        x, y, z = _lengths(shape, "size", 3)
        return Box((x, y, z))
    if shape.tag == "cylinder":
        return Cylinder(*_lengths(shape, "radius", 1), *_lengths(shape, "length", 1))
    if shape.tag == "sphere":
        return Sphere(*_lengths(shape, "radius", 1))
    if shape.tag == "mesh":
        uri = shape.attributes.get("filename", "").strip()
        if not uri:
            fix = '<mesh filename="package://PACKAGE/meshes/FILE.stl"/>'
            raise _ShapeError(shape, "its <mesh> names no file", fix)
        x, y, z = _numbers(shape, "scale", 3, (1.0, 1.0, 1.0))
        return MeshFile(uri, (x, y, z))
    message = f"<{quoted(shape.tag)[1:-1]}> is none of {', '.join(_GEOMETRIES)}"
    raise _ShapeError(shape, message, _SOME_GEOMETRY)


def _lengths(element: Element, name: str, count: int) -> tuple[float, ...]:
    lengths = _numbers(element, name, count)
    for length in lengths:
        if length < 0.0:
            raise _ShapeError(element, f"its <{element.tag}> has the negative length {length:g} m")
    return lengths


def _numbers(
    element: Element, name: str, count: int, default: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    if default is not None and name not in element.attributes:
        return default
    text = element.attributes.get(name, "")
    try:
        return (read_number(text),) if count == 1 else read_numbers(text, count)
    except NumberError as fault:
        fix = f'{name}="{"0.1" if count == 1 else "0 0 0"}"'
        raise _ShapeError(element, f"{element.tag} {name}: {fault}", fix) from None
