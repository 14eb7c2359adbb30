"""Universal atrial coordinates of the left atrium: alpha 0 septal .. 1 lateral, beta 0 posterior .. 1 anterior mitral rim.

Two rounds of Laplace solves (Roney et al. 2019, Med Image Anal 55:65). The first has the mitral rim, the roof line and the
septal and lateral lines as boundary values; it orders points around each vein. The second fixes the junctions of veins and
appendage to circles of one common square and solves the posterior and the anterior wall apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry import laplace

Line = Callable[[int, "IntArray | int"], IntArray]

VEINS = ("rspv", "ripv", "lspv", "lipv")


@dataclass(frozen=True)
class Circle:
    """An ellipse of the coordinate square: centre and half axes in (alpha, beta)."""

    alpha: float
    beta: float
    half_alpha: float
    half_beta: float


# The common square: junctions (outer) and rims (inner) of the vessels as in the published atlas.
JUNCTION = {
    "lipv": Circle(0.87, 0.315, 0.06, 0.06),
    "ripv": Circle(0.13, 0.315, 0.06, 0.06),
    "appendage": Circle(0.839, 0.865, 0.069, 0.075),
}
RIM = {
    "lipv": Circle(0.87, 0.315, 0.02, 0.02),
    "ripv": Circle(0.13, 0.315, 0.02, 0.02),
    "lspv": Circle(0.885, 0.555, 0.02, 0.02),
    "rspv": Circle(0.115, 0.555, 0.02, 0.02),
}
SUPERIOR_WIDTH, SUPERIOR_HEIGHT = 0.23, 0.11  # half ellipses of the superior junctions, standing on beta = 0.5
EDGE_PATHS_MM = 0.4
BAND = 0.01  # width, in the first round's coordinates, of the strips that stand for a line through a vessel's extreme


@dataclass(frozen=True)
class Parts:
    """What the coordinates need of a surface.

    points (n, 3) mm; triangles (t, 3), open at the mitral valve and at the veins' rims; vessel (t,): "" for the body, else
    a vein's name or "appendage"; mitral (k,) ordered point ids of the mitral rim. lateral, septal: points (3,) that the two
    side lines pass (None: the shortest way from the carina between the veins to the mitral rim); lspv_roof, rspv_roof: points on
    the roof side of the superior veins' junctions (None: the side that faces the other veins).
    """

    points: FloatArray
    triangles: IntArray
    vessel: NDArray[np.str_]
    mitral: IntArray
    lateral: FloatArray | None = None
    septal: FloatArray | None = None
    lspv_roof: FloatArray | None = None
    rspv_roof: FloatArray | None = None


@dataclass
class _Values:
    """Dirichlet values gathered for one solve; a point's later value replaces an earlier one."""

    of: dict[int, float] = field(default_factory=dict)

    def put(self, ids: IntArray, values: FloatArray | float) -> None:
        self.of.update(zip(ids.tolist(), np.broadcast_to(values, len(ids)).tolist(), strict=True))

    def arrays(self) -> tuple[IntArray, FloatArray]:
        return np.fromiter(self.of.keys(), np.int64, len(self.of)), np.fromiter(self.of.values(), float, len(self.of))


@dataclass(frozen=True)
class _Superior:
    """A superior vein's junction: from the point next to the inferior vein, over both sides, to the roof line's end."""

    near: int
    far: int
    roof: IntArray
    front: IntArray


def coordinates(parts: Parts, line: Line | None = None) -> FloatArray:
    """(n, 2) alpha and beta at the points of the surface; NaN at points of no triangle.

    ``line``: how lines are laid, from a point to one of several, as point ids; None: by ``line_finder``.
    Raises AnatomyError where a vein or the mitral rim is missing, or the lines do not part posterior from anterior.
    """
    points, triangles = parts.points, parts.triangles
    junction, rim = _vessel_loops(parts)
    line = line or line_finder(points, triangles)
    between = np.mean([points[junction[name]].mean(axis=0) for name in VEINS], axis=0)
    lspv = _superior(points, junction["lspv"], junction["lipv"], parts.lspv_roof, between)
    rspv = _superior(points, junction["rspv"], junction["ripv"], parts.rspv_roof, between)
    roof = np.concatenate([lspv.roof, line(lspv.far, rspv.far)[1:-1], rspv.roof[::-1]])
    lateral = _side_line(points, line, parts.lateral, lspv.near, parts.mitral)
    septal = _side_line(points, line, parts.septal, rspv.near, parts.mitral)

    # first round; across: 0 lateral .. 1 septal, up: 0 mitral rim .. 1 roof line
    matrix = laplace.stiffness(laplace.gradient(points, triangles), len(points))
    lateral, septal = np.setdiff1d(lateral, septal), np.setdiff1d(septal, lateral)
    across = laplace.solve(matrix, {0.0: lateral, 1.0: septal})
    up = laplace.solve(matrix, {0.0: np.setdiff1d(parts.mitral, roof), 1.0: roof})

    border = np.unique(np.concatenate([lateral, septal, roof]))
    posterior = _posterior_points(parts, border, junction)
    back = np.zeros(len(points), dtype=bool)
    back[posterior] = True
    on_border = np.zeros(len(points), dtype=bool)
    on_border[border] = True
    behind = (back | on_border)[triangles].all(axis=1) & back[triangles].any(axis=1)

    walls = {}
    for name, cells in (("posterior", triangles[behind]), ("anterior", triangles[~behind])):
        in_wall = np.zeros(len(points), dtype=bool)
        in_wall[cells] = True
        frame = _Frame(points, across, up, in_wall & ~on_border, line, junction, rim)
        fixed_across, fixed_up = _posterior_values(frame) if name == "posterior" else _anterior_values(frame, parts, lspv, rspv)
        for values, pairs in ((fixed_across, ((lateral, 0.0), (septal, 1.0))), (fixed_up, ((parts.mitral, 0.0), (roof, 1.0)))):
            for ids, value in pairs:
                values.put(ids[in_wall[ids]], value)
        wall = laplace.stiffness(laplace.gradient(points, cells), len(points))
        solved = []
        for values in (fixed_across, fixed_up):
            ids, fixed = values.arrays()
            keep = in_wall[ids]
            solved.append(laplace.solve(wall, (ids[keep], fixed[keep])))
        walls[name] = solved
    # where two ways to a landmark begin as one, the line has an end within the posterior wall: the anterior has no value there
    behind_only = back | ~np.isfinite(walls["anterior"][0])
    alpha = 1.0 - np.where(behind_only, walls["posterior"][0], walls["anterior"][0])
    beta = np.where(behind_only, 0.5 * walls["posterior"][1], 1.0 - 0.5 * walls["anterior"][1])
    return np.column_stack([alpha, beta])


def _vessel_loops(parts: Parts) -> tuple[dict[str, IntArray], dict[str, IntArray]]:
    """Ordered junction loop of every vessel present, and ordered rim loop of every open one."""
    junction: dict[str, IntArray] = {}
    rim: dict[str, IntArray] = {}
    for name in (*VEINS, "appendage"):
        inside = parts.vessel == name
        if not inside.any():
            if name == "appendage":
                continue
            raise AnatomyError(f"universal atrial coordinates need four veins; {name.upper()} is missing.")
        closed = paths.loops(paths.border_edges(parts.triangles, inside))
        if not closed:
            raise AnatomyError(f"the junction of {name} with the body of the atrium is not a closed curve.")
        junction[name] = max(closed, key=lambda loop: paths.perimeter(parts.points, loop))
        free = paths.loops(paths.open_edges(parts.triangles[inside]))
        free = [loop for loop in free if len(np.intersect1d(loop, junction[name])) < len(loop) // 2]
        if free:
            rim[name] = max(free, key=lambda loop: paths.perimeter(parts.points, loop))
    return junction, rim


def _superior(
    points: FloatArray, loop: IntArray, inferior: IntArray, roof_side: FloatArray | None, between: FloatArray
) -> _Superior:
    distance = np.linalg.norm(points[loop][:, None] - points[inferior][None], axis=2)
    near = int(loop[int(np.argmin(distance.min(axis=1)))])
    far = int(loop[int(np.argmax(np.linalg.norm(points[loop] - points[near], axis=1)))])
    arcs = [paths.arc(loop, near, far), paths.arc(loop[::-1], near, far)]
    if min(len(a) for a in arcs) < 3:
        raise AnatomyError("the junction of a superior vein has too few points for coordinates; use a smaller cell size.")
    if roof_side is None:
        gap = [float(np.linalg.norm(points[a[1:-1]] - between, axis=1).mean()) for a in arcs]
    else:
        gap = [float(np.linalg.norm(points[a[1:-1]] - roof_side, axis=1).min()) for a in arcs]
    first = int(np.argmin(gap))
    return _Superior(near, far, arcs[first], arcs[1 - first])


def line_finder(points: FloatArray, triangles: IntArray) -> Line:
    """How lines are laid: along edges as published on the finest meshes, else by the shortest way across triangles.

    Edge paths, and the ends that they find on a rim, follow the mesh more than the atrium: on one of 0.75 mm edges they moved
    a regional feature by 0.18 mm. The published atlas (0.32 mm edges) has them.
    """
    edges, _, _ = paths.edge_table(triangles)
    if float(np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1).mean()) > EDGE_PATHS_MM:
        return paths.Ways.over(points, triangles).path
    graph = paths.edge_graph(points, triangles)
    return lambda start, goals: paths.shortest_path(graph, start, goals)


def _side_line(points: FloatArray, line: Line, marker: FloatArray | None, vein: int, mitral: IntArray) -> IntArray:
    start = vein if marker is None else int(np.argmin(np.linalg.norm(points - marker, axis=1)))
    return np.union1d(line(start, vein), line(start, mitral))


def _posterior_points(parts: Parts, border: IntArray, junction: Mapping[str, IntArray]) -> IntArray:
    cut = np.isin(parts.triangles, border).any(axis=1)
    _, label = paths.triangle_components(parts.triangles, ~cut)
    touching = {
        name: set(np.unique(label[np.isin(parts.triangles, junction[name]).any(axis=1) & ~cut]).tolist())
        for name in ("ripv", "lipv")
    }
    common = touching["ripv"] & touching["lipv"]
    if len(common) != 1:
        raise AnatomyError(
            "the roof, septal and lateral lines do not leave both inferior veins on one posterior wall; "
            "check the side landmarks and the names of the veins in landmarks.toml."
        )
    return np.unique(parts.triangles[label == common.pop()])


@dataclass(frozen=True)
class _Frame:
    """The first round's coordinates on one wall, and the means to lay lines with them."""

    points: FloatArray
    across: FloatArray
    up: FloatArray
    free: NDArray[np.bool_]
    line: Line
    junction: Mapping[str, IntArray]
    rim: Mapping[str, IntArray]

    def strip(self, field: FloatArray, value: float, above: bool, where: NDArray[np.bool_]) -> tuple[IntArray, FloatArray]:
        """Points within BAND of an isoline on its outer side, and how far each is past it."""
        past = field - value
        hit = ((past > 0) & (past < BAND)) if above else ((past < 0) & (past > -BAND))
        ids = np.flatnonzero(hit & self.free & where)
        return ids, past[ids]

    def extremes(self, name: str) -> dict[str, int]:
        loop = self.junction[name]
        return {
            "left": int(loop[np.argmin(self.across[loop])]),
            "right": int(loop[np.argmax(self.across[loop])]),
            "low": int(loop[np.argmin(self.up[loop])]),
            "high": int(loop[np.argmax(self.up[loop])]),
        }

    def on_circle(self, loop: IntArray, circle: Circle, anterior: bool) -> tuple[IntArray, FloatArray, FloatArray]:
        """Loop points with the across and up values of a circle, its quarters between the loop's four extremes."""
        where = [
            int(np.argmax(self.across[loop])),
            int(np.argmax(self.up[loop])),
            int(np.argmin(self.across[loop])),
            int(np.argmin(self.up[loop])),
        ]
        size = len(loop)
        ahead = [(w - where[0]) % size for w in where]
        if not ahead[1] < ahead[2] < ahead[3] and ahead[1] > ahead[2] > ahead[3]:
            loop = loop[::-1]
            where = [size - 1 - w for w in where]
            ahead = [(w - where[0]) % size for w in where]
        turned = np.roll(loop, -where[0])
        along = paths.arc_parameter(self.points, np.append(turned, turned[0]))
        if 0 < ahead[1] < ahead[2] < ahead[3]:
            knots = [along[a] for a in ahead] + [1.0]
            theta = np.interp(along[:-1], knots, np.linspace(0.0, 2.0 * np.pi, 5))
        else:  # extremes out of order on a ragged loop: turn evenly, the way its area in (across, up) turns
            x, y = self.across[turned], self.up[turned]
            sense = np.sign(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) or 1.0
            theta = sense * 2.0 * np.pi * along[:-1]
        up_centre = 2.0 * (1.0 - circle.beta) if anterior else 2.0 * circle.beta
        return turned, 1.0 - circle.alpha + circle.half_alpha * np.cos(theta), up_centre + 2.0 * circle.half_beta * np.sin(theta)


def _posterior_values(frame: _Frame) -> tuple[_Values, _Values]:
    across, up = _Values(), _Values()
    left, right = JUNCTION["lipv"], JUNCTION["ripv"]
    low, high = 2.0 * (left.beta - left.half_beta), 2.0 * (left.beta + left.half_beta)
    ends = {name: frame.extremes(name) for name in ("lipv", "ripv")}
    for name, circle in (("lipv", left), ("ripv", right)):
        for side, above in (("left", False), ("right", True)):
            end = ends[name][side]
            ids, past = frame.strip(frame.across, frame.across[end], above, frame.up < frame.up[end])
            across.put(ids, 1.0 - circle.alpha + (1 if above else -1) * circle.half_alpha + past)
        for side, above, value in (("low", False, low), ("high", True, high)):
            end = ends[name][side]
            outer = frame.across < frame.across[end] if name == "lipv" else frame.across > frame.across[end]
            ids, past = frame.strip(frame.up, frame.up[end], above, outer)
            up.put(ids, value + past)
    for side, value in (("high", high), ("low", low)):
        up.put(frame.line(ends["lipv"][side], ends["ripv"][side]), value)
    for name in ("lipv", "ripv"):
        _put_circle(frame, across, up, frame.junction[name], JUNCTION[name], anterior=False)
        if name in frame.rim:
            _put_circle(frame, across, up, frame.rim[name], RIM[name], anterior=False)
    return across, up


def _anterior_values(frame: _Frame, parts: Parts, lspv: _Superior, rspv: _Superior) -> tuple[_Values, _Values]:
    across, up = _Values(), _Values()
    body = np.zeros(len(frame.points), dtype=bool)
    body[parts.triangles[parts.vessel == ""]] = True
    if "appendage" in frame.junction:
        circle = JUNCTION["appendage"]
        centre_across, centre_up = 1.0 - circle.alpha, 2.0 * (1.0 - circle.beta)
        ends = frame.extremes("appendage")
        for side, above in (("low", False), ("high", True)):
            ids, past = frame.strip(frame.up, frame.up[ends[side]], above, body)
            up.put(ids, centre_up + (1 if above else -1) * 2.0 * circle.half_beta + past)
        for side, above in (("left", False), ("right", True)):
            end = ends[side]
            ids, past = frame.strip(frame.across, frame.across[end], above, body & (frame.up < frame.up[end]))
            across.put(ids, centre_across + (1 if above else -1) * circle.half_alpha + past)
        across.put(frame.line(lspv.far, ends["right"]), SUPERIOR_WIDTH)
    across.put(frame.line(rspv.far, parts.mitral), 1.0 - SUPERIOR_WIDTH)
    middles = [int(v.front[len(v.front) // 2]) for v in (lspv, rspv)]
    up.put(frame.line(middles[0], middles[1]), 1.0 - 2.0 * SUPERIOR_HEIGHT)
    if "appendage" in frame.junction:
        _put_circle(frame, across, up, frame.junction["appendage"], JUNCTION["appendage"], anterior=True)
    for name, vein in (("lspv", lspv), ("rspv", rspv)):
        if name in frame.rim:
            _put_circle(frame, across, up, frame.rim[name], RIM[name], anterior=True)
        middle = vein.roof[len(vein.roof) // 2]
        for piece, start in ((_until(vein.roof, middle), 0.0), (_from(vein.roof, middle), 0.5)):
            s = start + 0.5 * paths.arc_parameter(frame.points, piece)
            across.put(piece, _outwards(name, SUPERIOR_WIDTH * s))
        middle = vein.front[len(vein.front) // 2]
        for piece, start in ((_until(vein.front, middle), 0.0), (_from(vein.front, middle), 0.5)):
            theta = np.pi * (start + 0.5 * paths.arc_parameter(frame.points, piece))
            across.put(piece, _outwards(name, 0.5 * SUPERIOR_WIDTH * (1.0 - np.cos(theta))))
            up.put(piece, 1.0 - 2.0 * SUPERIOR_HEIGHT * np.sin(theta))
    return across, up


def _outwards(name: str, across: FloatArray) -> FloatArray:
    """The left vein's place in the square, or its mirror image for the right one."""
    return across if name == "lspv" else 1.0 - across


def _until(path: IntArray, middle: int) -> IntArray:
    """The path up to and with the point ``middle``."""
    return path[: int(np.flatnonzero(path == middle)[0]) + 1]


def _from(path: IntArray, middle: int) -> IntArray:
    """The path from the point ``middle`` on."""
    return path[int(np.flatnonzero(path == middle)[0]) :]


def _put_circle(frame: _Frame, across: _Values, up: _Values, loop: IntArray, circle: Circle, anterior: bool) -> None:
    ids, x, y = frame.on_circle(loop, circle, anterior)
    across.put(ids, x)
    up.put(ids, y)
