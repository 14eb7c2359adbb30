"""Pictures for the quality report."""

from __future__ import annotations

from typing import Any

import numpy as np

from lacli.anatomy.surface import Surface


def polydata(surface: Surface) -> Any:
    """The surface as a VTK data set with its labels."""
    import pyvista as pv

    faces = np.column_stack([np.full(len(surface.triangles), 3), surface.triangles])
    mesh = pv.PolyData(surface.points, faces.ravel())
    mesh.cell_data["label"] = surface.label
    return mesh
