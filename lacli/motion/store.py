"""What tracking leaves in a folder: motion.npz, the surfaces of all frames as a series, transients."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lacli.anatomy.surface_features import Endocardium, cavity_faces
from lacli.base.arrays import FloatArray
from lacli.base.files import replacing, write_text
from lacli.contracts.bundle import Bundle
from lacli.geometry.subdivision import straight


def write_series(folder: Path, bundle: Bundle, surface: Endocardium, times: FloatArray, positions: FloatArray) -> Path:
    """One VTP a frame of the cavity's surface and ``series.pvd``, which ParaView opens as an animation.

    positions (f, n, 3) mm of the bundle's points. Point arrays: wall_point (id in the bundle), displacement (3) mm from ED; on the
    points of the body also its components normal_mm (out of the cavity), alpha_mm, beta_mm along the universal coordinates.
    """
    import pyvista as pv

    folder.mkdir(parents=True, exist_ok=True)
    faces = cavity_faces(bundle)
    # 6-node faces are cut in four, normals turned out of the cavity
    triangles = straight(faces)[:, ::-1]
    used, local = np.unique(triangles, return_inverse=True)
    cells = np.column_stack([np.full(len(triangles), 3), local.reshape(-1, 3)]).ravel()
    axes = nodal_axes(bundle, surface)
    entries = []
    for number, (time, x) in enumerate(zip(times, positions, strict=True)):
        mesh = pv.PolyData(x[used], cells)
        moved = (x - bundle.points)[used]
        mesh.point_data["wall_point"] = used.astype(np.int64)
        mesh.point_data["displacement"] = moved
        for name, axis in axes.items():
            mesh.point_data[f"{name}_mm"] = (moved * axis[used]).sum(axis=1)
        with replacing(folder / f"frame_{number:02d}.vtp") as temporary:
            mesh.save(temporary)
        entries.append(f'    <DataSet timestep="{time:.6g}" file="frame_{number:02d}.vtp"/>')
    head = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <Collection>"]
    write_text(folder / "series.pvd", "\n".join([*head, *entries, "  </Collection>", "</VTKFile>"]) + "\n")
    return folder / "series.pvd"


def nodal_axes(bundle: Bundle, surface: Endocardium) -> dict[str, FloatArray]:
    """Unit vectors (n, 3) at the bundle's points, means of the endocardial faces around: normal, alpha, beta; 0 elsewhere."""
    result = {}
    for name, vectors in (("normal", surface.normal), ("alpha", surface.alpha), ("beta", surface.beta)):
        if vectors is None:
            continue
        mean = (surface.area[..., None] * vectors).sum(axis=1)
        total = np.zeros((len(bundle.points), 3))
        for k in range(surface.faces.shape[1]):
            np.add.at(total, surface.faces[:, k], mean)
        size = np.linalg.norm(total, axis=1, keepdims=True)
        result[name] = np.divide(total, size, out=np.zeros_like(total), where=size > 0)
    return result
