"""Meshes of the verification problems, 10-node tetrahedra: boxes and ellipsoids by hand, spheres by gmsh. Lengths mm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import gmsh
import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle

# faces of a positively oriented tetrahedron, normals outwards; edges in VTK's order
_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
# gmsh has the middles of 23 and 13 the other way round
_FROM_GMSH = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]


def _middle_of(a: int, b: int) -> int:
    return next(4 + k for k, edge in enumerate(_EDGES) if set(edge) == {a, b})


# local nodes of each face, three vertices and the middles of their edges (01 12 20)
_FACE_NODES = np.array([[a, b, c, _middle_of(a, b), _middle_of(b, c), _middle_of(c, a)] for a, b, c in _FACES])


def with_boundary(points: FloatArray, tets: IntArray, tag: Callable[[FloatArray], IntArray]) -> Bundle:
    """A bundle of (n, 3) points and (m, 10) cells in VTK's order; ``tag`` names the boundary from its triangles' nodes
    (k, 6, 3) -> (k,). Unused points are dropped. Triangles' normals point out of the cells."""
    used, local = np.unique(tets, return_inverse=True)
    points, tets = points[used], local.reshape(-1, 10)
    faces = tets[:, _FACE_NODES].reshape(-1, 6)
    _, first, count = np.unique(np.sort(faces[:, :3], axis=1), axis=0, return_index=True, return_counts=True)
    triangles = faces[np.sort(first[count == 1])]
    return Bundle(
        points=points,
        tets=tets,
        region=np.ones(len(tets), dtype=np.int64),
        triangles=triangles,
        tags=tag(points[triangles]),
        info={},
    )


def box(
    breaks: tuple[FloatArray, FloatArray, FloatArray],
    tag: Callable[[FloatArray], IntArray],
    keep: NDArray[np.bool_] | None = None,
) -> Bundle:
    """A box of six tetrahedra a brick; ``breaks`` (a, b, c) are the bricks' ends along x, y, z; ``keep`` (a-1, b-1, c-1)
    leaves bricks out. The diagonals alternate, so that the mesh has no handedness."""
    sizes = [2 * len(b) - 1 for b in breaks]
    fine = [np.interp(np.arange(n) / 2, np.arange(len(b)), b) for n, b in zip(sizes, breaks, strict=True)]
    points = np.stack(np.meshgrid(*fine, indexing="ij"), axis=-1).reshape(-1, 3)
    bricks = np.stack(np.meshgrid(*[np.arange(len(b) - 1) for b in breaks], indexing="ij"), axis=-1).reshape(-1, 3)
    if keep is not None:
        bricks = bricks[keep.ravel()]
    cells = []
    for axes in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        steps = np.zeros((4, 3), dtype=np.int64)
        for k, axis in enumerate(axes):
            steps[k + 1 :, axis] = 1
        # mirrored in every second brick: neighbours then share their faces' diagonals
        corners = np.where(bricks[:, None, :] % 2 == 1, 1 - steps, steps) + bricks[:, None, :]
        even = np.linalg.det(np.diff(corners, axis=1).astype(np.float64)) > 0
        corners[~even] = corners[~even][:, [0, 2, 1, 3]]
        cells.append(corners)
    corners = 2 * np.concatenate(cells)
    nodes = np.concatenate([corners, (corners[:, _EDGES[:, 0]] + corners[:, _EDGES[:, 1]]) // 2], axis=1)
    return with_boundary(points, np.ravel_multi_index(tuple(np.moveaxis(nodes, -1, 0)), tuple(sizes)), tag)


def sides(nodes: FloatArray) -> IntArray:
    """Tags of a box's sides, 1 .. 6: x low, x high, y low, y high, z low, z high."""
    flat = nodes.reshape(-1, 3)
    low, high = flat.min(axis=0), flat.max(axis=0)
    tags = np.zeros(len(nodes), dtype=np.int64)
    for axis in range(3):
        for k, end in enumerate((low, high)):
            tags[np.abs(nodes[:, :, axis] - end[axis]).max(axis=1) < 1e-9 * (high - low).max()] = 1 + 2 * axis + k
    return tags


@contextmanager
def _model(size: float) -> Iterator[None]:
    """A gmsh model, second-order cells of one size (mm), middles on the true surface and untangled."""
    gmsh.initialize(["lacli", "-v", "0"], readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.NumThreads", 1)
        gmsh.option.setNumber("Mesh.MeshSizeMin", size)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.MeshSizeFromPoints", 0)
        gmsh.option.setNumber("Mesh.Optimize", 1)
        gmsh.option.setNumber("Mesh.ElementOrder", 2)
        gmsh.option.setNumber("Mesh.HighOrderOptimize", 2)
        yield
    except AnatomyError:
        raise
    except Exception as error:  # gmsh raises Exception itself
        raise AnatomyError(f"gmsh could not mesh a verification problem: {error}.") from error
    finally:
        gmsh.finalize()


def _meshed(tag: Callable[[FloatArray], IntArray]) -> Bundle:
    gmsh.model.occ.synchronize()
    gmsh.model.mesh.generate(3)
    numbers, coordinates, _ = gmsh.model.mesh.getNodes()
    _, nodes = gmsh.model.mesh.getElementsByType(11)
    where = np.zeros(int(numbers.max()) + 1, dtype=np.int64)
    where[numbers.astype(np.int64)] = np.arange(len(numbers))
    tets = where[nodes.astype(np.int64)].reshape(-1, 10)[:, _FROM_GMSH]
    bundle = with_boundary(coordinates.reshape(-1, 3), tets, tag)
    if not (worst := curved_determinant(bundle).min()) > 0:
        raise AnatomyError(
            f"gmsh {gmsh.__version__} made an inverted curved cell (determinant {worst:.3g}); try another cell size."
        )
    return bundle


INNER, OUTER, CUT = 1, 2, 3
# cells at the apex and at the clamped base are this much shorter than elsewhere
APEX, CLAMP = 0.5, 0.5


def sphere(inner: float, outer: float, size: float, octant: bool = True) -> Bundle:
    """A thick sphere, or its part x, y, z >= 0; tags INNER, OUTER, CUT."""

    def tag(nodes: FloatArray) -> IntArray:
        radius = np.linalg.norm(nodes, axis=-1)
        on_inner, on_outer = (np.abs(radius - r).max(axis=1) < 1e-6 * r for r in (inner, outer))
        return np.where(on_inner, INNER, np.where(on_outer, OUTER, CUT))

    with _model(size):
        occ = gmsh.model.occ
        shell = occ.cut([(3, occ.addSphere(0, 0, 0, outer))], [(3, occ.addSphere(0, 0, 0, inner))])[0]
        if octant:
            occ.intersect(shell, [(3, occ.addBox(0, 0, 0, 2 * outer, 2 * outer, 2 * outer))])
        return _meshed(tag)


def ellipsoid(
    size: float,
    layers: int = 1,
    inner: tuple[float, float] = (7, 17),
    outer: tuple[float, float] = (10, 20),
    cut: float = 5,
) -> Bundle:
    """A thick ellipsoid of revolution about z, semi-axes across and along it, cut off above z = ``cut``; tags INNER, OUTER,
    CUT. Cells of about ``size`` mm along the inner surface (half of it at the apex and at the base), ``layers``
    across the wall. A disc of triangles is taken to
    ellipsoids between the two, middles of edges too; both apices (negative z) are nodes."""
    length = np.pi - np.arccos(cut / inner[1])
    # along the inner surface from the apex, by polar angle: how many cells so far
    angle = np.linspace(0, length, 1000)
    share = angle / length
    local = size * np.minimum(1, np.minimum(APEX + (1 - APEX) * share / 0.4, CLAMP + (1 - CLAMP) * (1 - share) / 0.25))
    cells = np.hypot(inner[0] * np.cos(angle), inner[1] * np.sin(angle)) * angle[1] / local
    passed = np.concatenate([[0.0], np.cumsum((cells[1:] + cells[:-1]) / 2)])
    rings = max(3, round(passed[-1]))
    s = np.interp(np.linspace(0, passed[-1], rings + 1), passed, share)
    sizes = np.interp(s, share, local)
    counts = [max(6, round(2 * np.pi * inner[0] * np.sin(length * at) / h)) for at, h in zip(s[1:], sizes[1:], strict=True)]
    disc, triangles = _disc(s[1:], counts)
    flat = np.concatenate([np.column_stack([disc, np.full(len(disc), t)]) for t in np.linspace(0, 1, layers + 1)])
    corners = np.concatenate([_split_prisms(triangles + k * len(disc), len(disc)) for k in range(layers)])
    corners = _oriented(flat, corners)
    pairs, middle = np.unique(np.sort(corners[:, _EDGES], axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    tets = np.concatenate([corners, len(flat) + middle.reshape(-1, 6)], axis=1)
    # middles of the outline belong on its circle: average polar coordinates there
    flat = np.concatenate([flat, flat[pairs].mean(axis=1)])
    rim = np.abs(np.hypot(*flat[pairs][..., :2].transpose(2, 0, 1)) - 1).max(axis=1) < 1e-9
    here = len(flat) - len(pairs) + np.flatnonzero(rim)
    flat[here, :2] /= np.hypot(flat[here, 0], flat[here, 1])[:, None]
    s, t = np.hypot(flat[:, 0], flat[:, 1]), flat[:, 2]
    across, along = (inner[k] + t * (outer[k] - inner[k]) for k in (0, 1))
    polar = s * (np.pi - np.arccos(cut / along))
    radial = across * np.sin(polar) / np.maximum(s, 1e-300)
    points = np.column_stack([radial * flat[:, 1], radial * flat[:, 0], -along * np.cos(polar)])
    points[s < 1e-12] = np.column_stack([0 * t, 0 * t, -along])[s < 1e-12]

    def tag(nodes: FloatArray) -> IntArray:
        on_base = np.abs(nodes[..., 2] - cut).max(axis=1) < 1e-6
        gap = [np.hypot(nodes[..., 0], nodes[..., 1]) ** 2 / a**2 + nodes[..., 2] ** 2 / c**2 - 1 for a, c in (inner, outer)]
        return np.where(on_base, CUT, np.where(np.abs(gap[0]).max(axis=1) < np.abs(gap[1]).max(axis=1), INNER, OUTER))

    bundle = with_boundary(points, tets, tag)
    if not (worst := curved_determinant(bundle).min()) > 0:
        raise AnatomyError(f"An ellipsoid of {size:g} mm cells has an inverted one (determinant {worst:.3g}); try another size.")
    return bundle


def _disc(radii: FloatArray, counts: list[int]) -> tuple[FloatArray, IntArray]:
    """A disc's centre and rings of so many nodes, (n, 2), and the triangles between them, (m, 3) counter-clockwise."""
    points, triangles = [np.zeros((1, 2))], []
    before, first = np.zeros(1), 0
    for radius, count in zip(radii, counts, strict=True):
        turns = np.arange(count) / count
        start = first + len(before)
        if len(before) == 1:
            triangles += [[0, start + k, start + (k + 1) % count] for k in range(count)]
        else:
            i = j = 0  # of the inner ring and of the outer one; the nearer next node goes first
            while i < len(before) or j < count:
                a, b = first + i % len(before), start + j % count
                if j < count and (i == len(before) or (j + 1) / count <= (i + 1) / len(before)):
                    triangles.append([a, b, start + (j + 1) % count])
                    j += 1
                else:
                    triangles.append([a, b, first + (i + 1) % len(before)])
                    i += 1
        points.append(radius * np.column_stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)]))
        before, first = turns, start
    return np.concatenate(points), np.array(triangles)


def _split_prisms(bottom: IntArray, rise: int) -> IntArray:
    """Three tetrahedra a prism, (3 m, 4), of any orientation; the top is ``rise`` numbers above. Sorted numbers make
    neighbours agree on diagonals."""
    a, b, c = np.sort(bottom, axis=1).T
    ends = ((a, b, c, c + rise), (a, b, b + rise, c + rise), (a, a + rise, b + rise, c + rise))
    return np.concatenate([np.stack(end, axis=1) for end in ends])


def _oriented(points: FloatArray, corners: IntArray) -> IntArray:
    """The cells, two corners exchanged where their determinant is negative."""
    p = points[corners]
    negative = np.linalg.det(p[:, 1:] - p[:, :1]) < 0
    return np.where(negative[:, None], corners[:, [0, 2, 1, 3]], corners)


def curved_determinant(bundle: Bundle) -> FloatArray:
    """(m,) smallest determinant of each 10-node cell's map over its nodes, relative to its straight cell's."""
    vertex = np.array([[-1.0, -1.0, -1.0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    places = np.concatenate([np.eye(4), (np.eye(4)[_EDGES[:, 0]] + np.eye(4)[_EDGES[:, 1]]) / 2])
    i, j = _EDGES.T
    nodes = bundle.points[bundle.tets]
    smallest = np.full(len(nodes), np.inf)
    for b in places:  # barycentric coordinates
        middles = 4 * (b[i][:, None] * vertex[j] + b[j][:, None] * vertex[i])
        gradients = np.concatenate([(4 * b - 1)[:, None] * vertex, middles])
        smallest = np.minimum(smallest, np.linalg.det(np.einsum("mai,ak->mik", nodes, gradients)))
    straight = np.linalg.det(nodes[:, 1:4] - nodes[:, :1])
    return smallest / np.abs(straight)
