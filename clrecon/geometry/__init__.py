"""Where a voxel is: affines, patient frames, grids and volumes; numpy alone."""

from clrecon.geometry.affine import (
    SPACES,
    apply_affine,
    column_spacing,
    compose_affine,
    frame_from_lps,
    is_left_handed,
    lps_affine_from_ras,
    normal_matrix,
    signed_tilt,
    slice_normal,
    tilt_degrees,
)
from clrecon.geometry.blocks import slice_voxel_ml
from clrecon.geometry.grid import AIR_HU, METAL_HU, Grid
from clrecon.geometry.volume import Volume
