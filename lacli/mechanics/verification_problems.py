"""Meshes of the verification problems, 10-node tetrahedra: boxes by hand, spheres and ellipsoids by gmsh. Lengths mm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import gmsh
import numpy as np
from numpy.typing import NDArray

from lacli.anatomy.bundle import Bundle
from lacli.errors import AnatomyError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

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
    breaks: tuple[FloatArray, FloatArray, FloatArray], tag: Callable[[FloatArray], IntArray], keep: NDArray[np.bool_] | None = None
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
    cells, nodes = gmsh.model.mesh.getElementsByType(11)
    worst = float(np.min(gmsh.model.mesh.getElementQualities(cells, "minDetJac")))
    if not worst > 0:
        raise AnatomyError(f"gmsh {gmsh.__version__} made an inverted curved cell (determinant {worst:.3g}); try another cell size.")
    where = np.zeros(int(numbers.max()) + 1, dtype=np.int64)
    where[numbers.astype(np.int64)] = np.arange(len(numbers))
    tets = where[nodes.astype(np.int64)].reshape(-1, 10)[:, _FROM_GMSH]
    return with_boundary(coordinates.reshape(-1, 3), tets, tag)


INNER, OUTER, CUT = 1, 2, 3


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


def ellipsoid(size: float, inner: tuple[float, float] = (7, 17), outer: tuple[float, float] = (10, 20), cut: float = 5) -> Bundle:
    """A thick ellipsoid of revolution about z, semi-axes across and along it, cut off above z = ``cut``; tags INNER, OUTER,
    CUT. Both apices (negative z) are nodes."""

    def level(nodes: FloatArray, axes: tuple[float, float]) -> FloatArray:
        return np.abs(np.hypot(nodes[..., 0], nodes[..., 1]) ** 2 / axes[0] ** 2 + nodes[..., 2] ** 2 / axes[1] ** 2 - 1).max(axis=1)

    def tag(nodes: FloatArray) -> IntArray:
        on_base = np.abs(nodes[..., 2] - cut).max(axis=1) < 1e-6
        return np.where(on_base, CUT, np.where(level(nodes, inner) < level(nodes, outer), INNER, OUTER))

    with _model(size):
        occ = gmsh.model.occ
        bodies = []
        for across, along in (outer, inner):
            body = [(3, occ.addSphere(0, 0, 0, 1))]
            occ.dilate(body, 0, 0, 0, across, across, along)
            bodies.append(body)
        shell = occ.cut(bodies[0], bodies[1])[0]
        occ.cut(shell, [(3, occ.addBox(-50, -50, cut, 100, 100, 100))])
        return _meshed(tag)
