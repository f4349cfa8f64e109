"""Every tolerance of the tests: name = value  # reason.  A bound is loosened here or nowhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def float32_unit(points: ArrayLike) -> float:
    """One unit in the last place of the largest coordinate, in mm: what float32 vertices can hold."""
    return float(np.spacing(np.float32(np.abs(np.asarray(points)).max())))


# --- geometry: maps ---
FLOAT64_PLACE_MM = 1e-9  # coordinates of some 1000 mm there and back in float64

# --- files of clouds ---
SIX_DIGITS_MM = 5.1e-3  # Open3D writes six digits into text: half of 1e-2 mm from 1000 mm on
LAS_POINT_MM = 8.2e-5  # half a step of 1e-4 mm, and half a step of float32 at some 1000 mm

# --- operators: points of volumes ---
HALF_STEP = 0.5001  # of float32: a place is rounded once
CLOUD_PLACE_MM = 1.6e-5  # half a step of float32 below 512 mm
CLOUD_BALL_MM = 0.02  # a ball of 20 mm in voxels of 0.64 to 0.8 mm and whole HU: measured 0.009
BALL_OF_VOXELS = 2e-3  # relative volume of such a ball by counting voxels

CUT_SPLINE_HU = 1e-5  # a cubic spline of part of a volume; coefficients fade by 0.27 a voxel

# --- geometry: images of pyvista ---
IMAGE_POINT_MM = 1e-9  # VTK places points by direction and spacing in float64
IMAGE_SURFACE_MM = 1e-4  # float32 vertices some 200 mm from the origin, placed by another program: measured 2e-5
IMAGE_VOLUME = 1e-4  # of a sphere within one set of vertices, other fans of the same loops: measured 1e-5
RESAMPLED_RAMP_HU = 1e-3  # trilinear interpolation of a ramp of 500 HU is the ramp, in float32: measured 1e-4

# --- pictures in scenes of pyvista ---
FLOAT32_POINT_MM = 1e-4  # float32 coordinates up to 1000 mm: half a unit is 3e-5
FLOAT32_POINT_PIXEL = 1e-4  # the same in pixels of 9 mm, 100 mm from a camera
DRAWN_PICTURE_LEVELS = 1  # of 255; OpenGL may round colours down
DRAWN_BLEND_LEVELS = 3  # of 255, two blendings in 8 bits, one of them divided by an opacity of 0.4
DRAWN_OUTLINE_SHARE = 0.01  # pixels on the outlines of balls of 120 facets, smoothed by the driver; measured 0.004
DRAWN_DEPTH_MM = 0.4  # facets of a ball of 20 mm sag 0.03, and more where they are seen edge on: measured 0.2

# --- pictures against VTK's fixed-point mapper: SSIM of luminance ---
VTK_LIKENESS_SMOOTH = 0.99  # samples of another phase, HU rounded to integers; measured 0.995 to 0.999
VTK_LIKENESS_SPINE = 0.95  # the bar; it interpolates shades of voxels, we shade interpolated gradients: measured 0.954
BENCH_LIKENESS = 0.98  # SSIM of a ball in 60 x 50 pixels; measured 0.9935 to 0.9993
VTK_LIKENESS_SPINE_UNSHADED = 0.99  # measured 0.997

# --- geometry: iso value half way between two materials ---
HALF_WAY_STEP_SHARE = 0.03  # of the step between the materials, up to blur 1.5 voxels and 5 % noise: measured 0.025
HALF_WAY_SHIFT_HU = 3  # what a shift, a scale, air, padding, table or metal may move it by: measured 2 (other edges)
HALF_WAY_CONTRAST_MEDIUM_HU = 15  # bone behind a vessel without its edge, and partial volume of both: measured 8
HALF_WAY_STRIDE_HU = 20  # every fifth of 40 slices in place of each: other bones, measured 12

# --- operators ---
TWIN_VERTEX_VOXEL = 1e-4  # device in float32 against twin in float64, index steps
VERTEX_ROUNDING_UNITS = 0.6  # half a unit of the last rounding, and what is lost before it
FAR_VERTEX_MM = 2e-6  # volumes of 30 mm far from the origin: float32 near their centre; measured 6e-7
FAR_SCAN_MM = 5e-6  # the same, read from positions with 6 decimals, which the fit of the affine averages
TWIN_NORMAL = 2e-5  # unit vectors in float32
FRAME_MM = 1e-4  # one surface through differently ordered voxels
SPHERE_DISTANCE_FIELD_VOXEL = 0.03  # sagitta of one edge at R = 5 voxels is 1/40 voxel; measured 0.025
SPHERE_PARTIAL_VOLUME_RMS_VOXEL = 0.05  # box-averaged edges bend; measured 0.044
SPHERE_PARTIAL_VOLUME_MAX_VOXEL = 0.15  # measured 0.103
TWIN_CELL_NORMAL = 2e-4  # normals inside cells: near a saddle the gradient is a small difference; measured 4e-5
LINEAR_FIELD_MM = 1.2e-3  # vertices keep 4 units of 600 mm off samples, measured in the smallest gap of 0.4 to 1.9 mm
LINEAR_FIELD_NORMAL = 2e-4  # differences of float32 values over steps of half a millimetre
WAIST_DISTANCE_STEP = 1e-9  # the waist of a tunnel: corners of straight lines of the surface, in float64
CENTRE_DISTANCE_STEP = 0.01  # steps of Newton end this near in 95 % of cells; the others have a flat spot

# --- dicom ---
AFFINE_MM = 1e-6  # positions and directions are written with 9 decimals (6 where coordinates are 1e5 mm)
ROUNDED_AFFINE_MM = 0.006  # positions rounded to 0.01 mm: half of it, and the fit averages most of that out
HEADER_BYTES = 1100  # what a scan of a long tree keeps of a slice, its path included: measured 760 to 870
SCAN_PEAK_BYTES_A_FILE = 1300  # with the list of paths and 64 starts of files: measured 930 to 990
FAR_AFFINE_MM = 1e-3  # coordinates of 1e5 mm, positions written with 6 decimals: measured 1e-6
JITTER_AFFINE_MM = 1e-4  # directions off by 0.001 degrees in every slice: 8e-5 mm over a corner 4.6 mm away

PEAK_HU = 12  # noise of 12 HU; peaks are found in bins of a few HU
SMALL_BODY_PEAK_HU = 15  # the same of a finger, whose soft tissue is blurred over a twentieth of the picture
GRID_PLACE_MM = 1e-4  # ITK and sforms of NIfTI keep float32 of places of some 100 mm
GRID_SPACING_MM = 1e-5  # pixdim of NIfTI is float32
RESAMPLED_HU = 1e-3  # a linear field of up to 1500 HU, interpolated in float32
GRID_REFUSAL_BYTES = 8e6  # what a refused file may take; it would need 19 MB

DISC_SHARE = 0.001  # of voxels: pixels at the rim of a disc of 46 voxels
DISC_AIR_HU = 5  # the middle of a peak of air with noise of 40 HU
OWN_SCALE_HU = 25  # levels found on another scale, in HU: a step of the histogram
OWN_SCALE_BONE_HU = 40  # the same of bone, whose peak is wide
OWN_SCALE_PEAK = 15  # of the scan's own values
TILT_DEG = 1e-6  # from positions with 9 decimals
DIRECTION = 1e-8  # direction cosines with 9 decimals
INVERSE_AFFINE_VOXEL = 1e-5  # positions with 9 decimals through the inverse, in voxels of half a mm and more

REAL_AFFINE_MM = 5e-4  # decimal strings of pixel spacings with six digits over 512 pixels
REAL_MEAN_HU = 1e-3  # the known mean has four decimals
REAL_FAR_CORNER_MM = 1e-3  # PixelSpacing has six decimals, 511 pixels away
REAL_TILT_DEG = 0.05  # the known tilt has one decimal

JITTER_DIRECTION = 0.5e-5  # 0.001 degrees are 1.7e-5, of which an average over eight slices leaves none
RIGHT_ANGLE = 1e-9  # products of direction cosines in float64
PLANES_S = 10.0  # of processors, for 3,000 planes; 18 s where each is compared with all others
GRID_RESIDUAL_MM = 1e-9  # positions with 9 decimals of an even plan

PADDING_BORDER_SHARE = 0.03  # of pairs of neighbours: chance over some hundred pairs at the circle
REAL_TUBE_SHARE = 0.15  # of pairs of neighbours at the circle that noise of air crosses

THOUSAND_FRAMES_S = 1.0  # of processors, for headers of 1000 frames in one file; measured 0.11

# --- labels ---
LABEL_FLOAT64 = 1e-12  # relative; volumes, means and places of some hundred voxels in float64
INSIDE_SHARE = 1e-12  # shares of some hundred voxels in float64
LABEL_SD_FLOAT64 = 1e-9  # relative; a root of a sum of squares in float64
UNEVEN_LABEL_VOLUME = 0.01  # a map with four even slices to the smallest of uneven gaps; measured 0.004
DECIMAL_PLACE_MM = 1e-9  # affines of NRRD and MetaImage, whose decimals say a float64 exactly
TILTED_CANAL_DICE = 0.97  # of a canal of 20 x 16 x 14 mm tilted by 20 degrees: its shift is rounded to whole voxels
HEADER_PEAK_BYTES = 8e6  # what reading a header may take that is refused; its file has some hundred bytes
EQUAL_DISTANCE_MM = 1e-9  # distances of a few mm in float64 that are equal but for rounding
LABEL_NIFTI_MM = 1e-4  # places of some 100 mm from a sform in float32, at voxels away from the first
DICOM_PLACE_MM = 1e-6  # positions written as decimal strings of 16 characters
NIFTI_LARGE_AFFINE_MM = 5e-5  # the same of coordinates up to 1000 mm: half a unit of float32 is 3e-5
VTK_PLACE_MM = 1e-5  # points of a grid of VTK, float32
NIFTI_AFFINE_MM = 1e-5  # sform entries and quaternions are float32: coordinates of some 100 mm

REAL_SOLID_VOLUME = 0.05  # a vertebra at 2 mm and 200 HU against its mask, which a network drew; measured -1.2 %
MASK_VOLUME = 0.001  # of a mask's volume; levels are looked for until 0.0003 is reached
MASK_VOLUME_THIN = 0.03  # one level more or less changes the six vertices of a single voxel by 1.2 %; measured 2.1 %
MASK_VOLUME_FILLED = 0.02  # of labels that fill a map: notches where three of them meet take 0.8 % of such small ones
MASK_SPHERE_NORMAL_DEG = 5.0  # rms over the vertices of masks of spheres; measured 3.6 to 4.7, with steps 15
MASK_SPHERE_VOXEL = 0.12  # rms distance from the sphere; measured 0.07 to 0.1, with steps 0.20
MASK_PLANE_NORMAL_DEG = 5.0  # of a tilted plane; measured 3.5, with steps 20
LABEL_SPHERE_VOLUME = 0.015  # chords of a partial-volume sphere of 9.4 voxels lose 1 %; measured 0.9 %

# --- phantom ---
PHANTOM_VOLUME_RATIO = 1e-3  # sum of partial volumes against analysis; the cell ramp leaves 0.03 % at R = 5 voxels
PHANTOM_PLANE_SHARE = 0.03  # linear ramp against the exact share of a cell, 1 of 6 cells along an edge
PHANTOM_DISTANCE_MM = 0.02  # brute force over surface points 0.5 mm apart: sagging chord of a curved surface
PHANTOM_MESH_AREA_RATIO = 0.01  # marching cubes on partial volume cuts convex surfaces: R = 9 voxels
PHANTOM_MESH_VOLUME_RATIO = 0.012  # marching cubes on partial volume: -0.9 % at R = 10 voxels (TRUST 2.1)
PHANTOM_POSITION_MM = 1e-9  # decimal strings of 16 characters near 1000 mm
PHANTOM_FACET_MM = 0.1  # gap of facets measured from points of the cover 1 mm apart, not at its narrowest place
PHANTOM_TRUTH_NEAR_MM = 0.02  # the largest of 99 %; measured 0.001 within 0.5 mm of bone, 0.012 elsewhere
PHANTOM_TRUTH_MM = 0.2  # the largest: beside facets that nearly touch 0.19, else 0.11
PHANTOM_BLUR_HU = 1e-3  # float32 sums of 1000 HU against scipy

# --- pipeline ---
VTK_SURFACE_HD95_VOXEL = 0.05  # the bar; measured 3e-5: only rounding differs
TOPOLOGY_SHARE = 5e-3  # of triangles and volume, separated against trilinear on CT: measured 1e-3 and 2e-3
VTK_VOLUME = 2e-3  # the bar; measured 5e-5 at 226 HU, at most 8e-4 from 200 to 700 HU: other fans of the same loops

# --- mesh ---
MESH_VOLUME = 1e-6  # relative; float32 corners of a solid with exact corners, summed in float64
MESH_UNIT_NORMAL = 1e-6  # float32 components; the text formats keep six decimals
PEER_MEASURE = 1e-5  # relative areas and volumes of float32 vertices, summed by another program or about another origin
FAR_MEASURE = 1e-4  # relative volume of a body of 26 mm, float32 vertices rounded 700 mm from the origin
MOVED_VERTEX_MM = 1e-5  # float32 coordinates of some 100 mm: half a step is 4e-6
FLOAT32_SHARE = 1e-6  # relative, a value rounded to float32 a few times
NEAREST_MM = 1e-12  # a distance of a few mm in float64
FLAT_TRIANGLE_MM = 1e-7  # of triangles whose corners nearly lie in a line: the root of rounding 1e-14 mm2
VTK_HIT_MM = 1e-6  # lines and points some 20 mm from float32 triangles, both in float64
CROSSING_STEP = 1e-4  # steps of a lattice: lines lie 2e-5 beside its points
NEAREST_SAMPLED_MM = 0.02  # 400 random points on each triangle of 0.6 mm, seen from inside or 4 mm away
FAR_FILE_MM = 1e-6  # fifteen digits, float64, or float32 of 15 mm with the rest in the matrix, at 1e5 mm
GLB_METRES = 1e-7  # relative; float32 coordinates through a float64 matrix, read back by another library

GLB_SCENE_M = 1e-7  # metres of a scene of 1 m in float32
SCALED_MM = 1e-7  # relative; coordinates times a unit, in float32
GLB_COLOR = 1e-4  # linear colours of glTF and back to sRGB
ASSEMBLY_COLOR = 1e-3  # colours of 8 bits, or linear ones with few digits
GLB_NODE_MM = 1e-3  # float32 metres of some metres through matrices of nodes
SAME_SURFACE_MM = 1e-6  # distances of a surface of 8 mm from itself in float32
FAR_CLOUD_MM = 1e-9  # float64, or fifteen digits, at 2e4 mm
CLOUD_ESTIMATE_LOW, XYZ_ESTIMATE_LOW = 0.9, 0.15  # of the size; lines of XYZ are counted at their shortest
PAGE_STEP_SHARE = 1e-12  # relative; the spread of coordinates over 65,535, in float64
PAGE_NORMAL = 0.5 / 127 * 18**0.5  # half a step in x and y, one in z, of a vector at least 1 / sqrt 3 long
HALF_STEP = 0.5 * (1 + 1e-9)  # of a step of coordinates, and rounding
PAGE_FLAT_MM = 1e-12  # ends of a range, which are whole steps
PAGE_CLICK_MM = 0.3  # a click lies in the middle of a pixel of 0.15 to 0.3 mm
PAGE_CLICK_DEGREES = 1.0  # the same over sides of 18 and 38 mm
PAGE_SPHERE_MM = 0.3  # triangles of 1 mm on a sphere of 30 mm sag 0.01 mm; picks go through pixels
PAGE_BOX_MM = 0.01  # float32 places of some 300 mm
PAGE_VISIBLE_SHARE = 0.03  # of pixels: what changes when a part of a fifth of the picture does
PAGE_TOUCH_ZOOM = 0.1  # relative; fingers are told in whole pixels
EXACT_MATRIX = 1e-12  # products of matrices of millimetres and metres in float64
FAR_STL_STEPS_MM = 0.05  # 100 m from the origin a step of float32 is 0.008 mm; vertices are moved by a few
PAGE_CORNER_MM = 2e-3  # half a step of 200 mm in 65,535
ROUNDED_STEP = 1e-9  # relative, over half a step: float64 coordinates of some 900 mm
ESTIMATE_LOW, ESTIMATE_HIGH = 0.5, 1.1  # of the size of a file: digits and compression are guessed

# --- smoothing, decimation, distances ---
SPHERE_SAGITTA_MM = 0.004  # triangles of 0.49 mm on a sphere of 10 mm sag 0.003 mm
BALL_SAGITTA_MM = 0.011  # triangles of up to 0.8 mm on balls of 10 mm sag 0.0097 mm, tori of 0.4 mm less
SMOOTHED_NOISE_SHARE = 0.5  # white noise through a filter that passes a tenth of the band; measured 0.33 to 0.42
SMOOTHED_RADIUS_MM = 0.01  # noise of 0.1 mm on 20 mm; a Laplacian of as many steps loses 0.2 mm
SHELL_VOLUME = 1e-5  # a wall of 0.3 mm, whose volume is restored; measured 4e-7
SMOOTHED_VOLUME = 2e-3  # the gate is 5e-3
DECIMATED_VOLUME = 2e-3  # triangles of 3 mm on a sphere of 20 mm lie on both sides of it
SAMPLED_PLANE_MM = 0.01  # quantiles and means of 20,000 even samples of 30 mm
SAMPLED_CENTRE_MM = 0.02  # mean of 3000 even samples of a triangle of 9 mm
TWO_BALLS_MM = 0.003  # gap of balls of the same 60 rings, whose triangles sag alike (0.008 mm); measured 0.0014
SHELL_WALL_MM = 0.005  # two spheres, each with triangles of some 0.6 mm that sag 0.003 mm; measured 0.0012
DIFFERENCE_HU = 1e-7  # rounding of values up to 1000 HU, 1e-13, over a step of 2e-4; measured 4e-9
FLOAT32_PLANE_MM = 1e-4  # voxels of float32 up to 500 HU, 40 HU a mm
TRILINEAR = 1e-9  # float64 against scipy and analysis
ISO_VERTEX_VOXEL = 1e-4  # vertices of the twin: held off the samples by up to 2e-4 of a step, rounded nowhere
DEVICE_ISO_VERTEX_VOXEL = (
    5e-4  # float32 millimetres 1 m from the origin are 6e-5 mm; held off samples by 2e-4 of a step
)
REFINED_TORUS_VOLUME = 0.03  # partial volume takes 1.2 % off so thin a torus, the gate on refinement 0.5 %
ISO_SPHERE_SAGITTA_MM = 0.025  # between samples 0.7, 0.5 and 0.9 mm apart a sphere of 8 mm sags sum(h^2) / 8 R
CORTEX_SHELL_VOLUME = 0.025  # shells of 9 and 13 mm in voxels of 1 mm, blurred by 0.7 mm: measured 0.016
CORTEX_SHELL_AREA = 0.03  # the same: measured 0.013
CORTEX_SHELL_WALL_MM = 0.3  # their walls of 2 and 3 mm: measured 0.22

# --- rays ---
RAY_CHORD = 0.005  # the bar; linear interpolation takes h^2 / 12 of the curvature of a ball: measured 0.0026
RAY_AXIS_HU = 0.05  # float32 indices of some 100 voxels, 1e-5 of a step, times steps of up to 3000 HU between voxels
RAY_TIP_VOXEL = 0.5  # a highest value that is flat along the ray, linear between voxels: measured 0.32
RAY_OPACITY = 0.5 / 255 + 5e-4  # 8 bits; chords of some 10 mm in float32
RAY_ROUNDING = 0.1  # of 255: what rounding two pictures to 8 bits leaves of their distance
RAY_SILHOUETTE_VOXEL = 0.08  # a ball of 5 to 10 voxels sags by h^2 / 8 R = 1/40 of a voxel along each axis
RAY_DEPTH_VOXEL = 0.1  # the bar; measured 0.053 on balls, where the field between voxels sags
RAY_DISC_AREA = 0.005  # pixels of a disc of 20 on a grid: measured 0.001
RAY_RESAMPLED_255 = 4  # two samplings of one smooth field, 1.9 mm at most: measured 3
RAY_STEP_LIKENESS = 0.99  # SSIM of pictures by the default step and by one ten times finer: the bar
RAY_SAME_255 = 1  # rounding to 8 bits the other way
LABEL_COLOR_255 = 6  # straight colours are premultiplied ones of 8 bits over opacities of some tens; measured 3
RAY_OUTLINE_SHARE = 0.02  # of pixels: at outlines triangles and the trilinear field between voxels are hit or missed
RAY_TWIN_SHARE = 0.002  # of pixels: float32 takes the other side of a step of the table, or of an edge; measured 0
RAY_TWIN_WORST_255 = 8  # such a pixel gains or loses one faint sample; measured 1
RAY_TWIN_HU = 0.5  # extremes snap to 1/4096 of a voxel, steps of 2500 HU between neighbours: measured 0.34
RAY_TWIN_DEPTH_MM = 0.01  # depths of some 200 mm in float32, and sums of 100 of them
RAY_TWIN_DEPTH_SHARE = 0.02  # of pixels: the first hit may be a sample on

# --- pipeline and command line ---
PHANTOM_SPHERE_VOLUME_SHARE = 0.01  # sphere of about 12 mm in voxels of 0.5 x 0.7 x 1 mm: measured -0.34 %
CLI_SPHERE_VOLUME_SHARE = 0.02  # sphere of 9 mm in voxels of 0.8 x 1.1 x 1.5 mm, its edge a ramp of 1 mm
CLI_SPHERE_RADIUS_MM = 0.3  # sagitta of chords of 1.8 mm and the bent ramp; measured -0.26

# --- views in a browser ---
JPEG_GREYS = 2  # of 256; what a flat grey changes by in a picture for the browser
VIEW_CHANGED_SHARE = 0.01  # of pixels; measured 0.04 where a ball of 5 mm is hidden, 0.12 where the view is turned
VIEW_REDRAWN_SHARE = 0.002  # of pixels of the same view, drawn and compressed again; measured 0
VIEW_LEVEL_HU = 0.5  # ends of a window are whole HU
VIEW_PART_ML = 0.03  # relative; 0.113 ml is listed as 0.11
VIEW_CLICK_MM = 0.3  # a click lies in the middle of a pixel, on a sphere of 3 mm and more
VIEW_POINTED_MM = 0.6  # the mouse lies in the middle of a pixel, and places are said in tenths
VIEW_MOVED_PIXELS = 1.0  # the mouse moves by whole pixels
VIEW_BOX_MM = 0.01  # facts hold places in hundredths
VIEW_LINE_SEEN_MM = 2.0  # of a line of 24 mm that two balls hide from behind; measured 4.6
VIEW_LINE_SEEN_SHARE = 0.7  # of the same line from the front; measured 0.81

# --- rendering: files of pictures and what is drawn into them ---
PNG_RESOLUTION = 1.3e-3  # relative; PNG holds whole pixels a metre, half of one of 400 at 2.5 mm a pixel
JPEG_MEAN_GREY = 3.0  # of 255, quality 95 on a sharp edge between saturated colours; measured 0.9
ROUND_BAR = 1e-6  # relative; powers of ten in float64
VTK_PIXEL = 1e-9  # relative to the largest coordinate; float64 through VTK's matrix
MP4_MEAN_GREY = 3.0  # of 255: half the colour resolution on 64 x 40 pixels with sharp edges; measured 1.5
MP4_FLAT_GREY = 4  # of 255: 8 bits in the limited range, and x264; measured 2
GIF_MEAN_GREY = 4.0  # of 255: 256 colours, dithered; measured 1.9

# --- rendering: transfer functions ---
FLOAT64_SHARE = 1e-12  # colours, opacities and unit vectors of order 1 in float64
STEP_SIDE = 1e-6  # opacities of order 1: rounded to float32, or 0.0001 HU beside a step of 200 HU
BENT_WAY = 0.003  # 32 straight parts in place of VTK's bent way between two nodes: measured 0.0017
COLOR_SPACE_WAY = 0.006  # 64 straight parts of RGB in place of a way through HSV or Lab: measured 0.005

# --- filters of volumes ---
FILTER_ROUNDED_HU = 0.501  # whole numbers are rounded from the twin's mean; sums in float32 add 1e-3
FILTER_FLOAT_HU = 2e-3  # sums of some hundred weights in float32, each within 4e-6, at 100 HU; measured 1e-4
FILTER_ITK_HU = 1.0  # the bar: ITK takes the weights of differences from a table of 100; measured 0.75
FILTER_OPENCV_HU = 2e-3  # OpenCV takes weights from a table of 4,096 a channel; measured 3e-4
NOISE_SHARE = 0.05  # relative, the noise that is measured in soft tissue; measured 0.02 on even tissue

# --- slices and curved reformations ---
TWIN_SLICE_HU = 1e-4  # float32 interpolation of values up to 100 HU, sums of 30 of them; measured 2e-5
SLICE_LINEAR_FIELD_HU = 4e-5  # values up to 80 HU, rounded to float32 before and after interpolation; measured 9e-6
SLAB_MEAN_HU = 1e-4  # sums of 80 values up to 100 HU in float32
ARC_LENGTH = 1e-5  # relative; splines through points 14 mm apart on a circle of 80 mm; measured 1.3e-6
ARC_STEP_MM = 1e-6  # Newton on integrals of five nodes against chords of a polyline 200 times finer; measured 1.3e-8
FRAME_RADIANS = 1e-9  # double reflection is exact on a helix; measured 3e-13
ISOMETRY = 1e-5  # relative; chords of 0.075 mm on a cylinder of 20 mm against arcs; measured 6e-7
SPLINE_CURVATURE = 0.03  # relative; second derivatives of a spline where it begins; measured 0.020
TUBE_EDGE_MM = 0.05  # distance field of a tube of 7 mm in voxels of 0.7 to 1.2 mm: h^2 / 8 r; measured 0.026
TUBE_ARC = 1e-3  # relative, the bar on arc lengths in a picture; measured 6e-5, 1.2e-6 for the whole
CANAL_MEAN_MM = 1.5  # canal of the spine phantom, 20 mm wide, on cells of 2.5 x 2.5 x 4 mm; measured 0.70
CANAL_MAX_MM = 2.5  # measured 1.13
REAL_CANAL_MEAN_MM = 2.5  # cord and canal of labels that a network drew at 2 and 3 mm; measured 1.0 and 1.8
REAL_CANAL_MAX_MM = 4.0  # measured 1.6 and 2.7

# --- operators: rays to surfaces and slices in space ---
SLICE_EDGE_SHARE = 0.01  # of pixels: at edges of slices and at the lowest HU float32 takes the other side
SLICE_DEPTH_MM = 1e-3  # depths of 200 mm in float32: 2e-5, over the cosine between ray and slice
SURFACE_RAY_VOXEL = 0.1  # the bar; a ball of 7 mm sags h^2 / 8 R between voxels, more along grazing rays: measured 0.06
SURFACE_TWIN_SHARE = 0.01  # of pixels: outlines, and edges of shadows, that float32 puts on the other side
SURFACE_TWIN_MM = 0.005  # a crossing is sought to 1e-3 of a step of up to 1.7 mm
WINDOW_SHARE = 0.51 / 16384  # weights of 14 bits, rounded

# --- points ---
SPLAT_DEPTH_MM = 1e-4  # float32 sums of 60 mm, and their products with a slanted ray: measured 8e-6
SPLAT_COLOR_LEVELS = 1.01  # of 255: the table of highlights and the last rounding
FAR_SPLAT_SHARE = 0.01  # pixels at rims of discs or triangles, moved by a step of float32
LAYER_LEVELS = 2.6  # of 255: rounding of colour and opacity, and the hundredth behind what is nearly opaque
RAY_LENGTH_SHARE = 1e-6  # the length of a slanted ray in float32, and the product with it
BALL_MESH_DEPTH_MM = 0.02  # a ball of 8 mm of 90 rings lies 0.005 mm below its sphere, and its depth at a slope of 4
MEAN_SPACING = 0.15  # an estimate from cells of about four points: measured 0.08
FILTER_TRUTH_SHARE = 0.1  # noise that is left on shapes of some 9,000 random points: seeds differ by 2 %
FILTERED_PLANE_MM = 1e-5  # a plane without noise stays within the rounding of float32; measured 2e-6
TREE_DISTANCE_STEPS = 4  # steps of float32: four roundings against a distance in float64; measured 1.5
TWIN_AXIS_DEGREES = 1e-3  # float32 against float64; measured 2e-6
TWIN_AXIS_NEAR_DOUBLE_DEGREES = 0.1  # where the two smaller eigenvalues differ by 1e-3 of the largest; measured 5e-4
GRADIENT_SHARE = 1e-4  # of the steepest gradient: weights from float32 coordinates of 40 voxels; measured 2e-5
TWIN_FILTER_MM = 1e-5  # the bar: exp and normals in float32 at coordinates up to 30 mm; measured 3e-6
MEAN_DISTANCE_SHARE = 1e-5  # sums of 16 distances in float32
TWIN_FIELD_MM = 2e-5  # float32 sums of some 30 heights of up to 2 mm, places up to 30 mm: measured 3e-6
FAR_FIELD_MM = 1e-3  # a cloud that moved by steps of float32 at 1e5 mm has its nodes elsewhere in it: measured 2e-4

CORRIDOR_RADIUS_MM = 0.15
"""Corridors of a cylinder with partial volume: a trilinear surface of 0.8 to 1 mm voxels, and the last step of the
search."""

CORRIDOR_PLACE_MM = 0.5
CORRIDOR_END_MM = 1.0
"""The line of a corridor lies within half a voxel beside the axis of its cylinder, and ends within one."""

CORRIDOR_FRAME_DEG = 2.5
CORRIDOR_ANGLE_DEG = 4.0
"""A line of 0.1 mm less radius may turn by some degrees within a short cylinder."""

SEGMENT_DISTANCE_MM = 2e-3
"""float32 coordinates of some centimetres, and the steps of the expected values along a segment."""

CORRIDOR_HALF_MM = 0.5
CORRIDOR_226_MM = 1.0
"""Bars for a corridor's radius against the truth along its line, at the half level and at 226 HU."""

PICTURE_ACTOR_LEVELS = 8
PICTURE_ACTOR_OPAQUE_SHARE = 0.001
PICTURE_ACTOR_TRANSLUCENT_SHARE = 0.01
"""Bars for a picture that is drawn by VTK with its own depth, against `merge_scene`: levels of 255, and shares of the
pixels that may differ by more, where two surfaces lie in one place."""
