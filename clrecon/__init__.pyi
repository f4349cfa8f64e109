"""The public names of clrecon and where they are: the one list, for type checkers, editors and `clrecon` itself."""

from clrecon.anatomy.body import mask_field_of_view as mask_field_of_view
from clrecon.anatomy.body import remove_table as remove_table
from clrecon.anatomy.iso_choice import choose_iso_value as choose_iso_value
from clrecon.anatomy.noise import Noise as Noise
from clrecon.anatomy.noise import measure_noise as measure_noise
from clrecon.anatomy.spine_line import find_spine_line as find_spine_line
from clrecon.errors import Cancelled as Cancelled
from clrecon.errors import ClreconError as ClreconError
from clrecon.errors import DeviceError as DeviceError
from clrecon.errors import NoDicomError as NoDicomError
from clrecon.errors import NoSurfaceError as NoSurfaceError
from clrecon.errors import OutputError as OutputError
from clrecon.errors import RefusedInputError as RefusedInputError
from clrecon.errors import UsageError as UsageError
from clrecon.geometry import Volume as Volume
from clrecon.labels import LabelMap as LabelMap
from clrecon.labels import read_labels as read_labels
from clrecon.mesh import Mesh as Mesh
from clrecon.mesh.compare.cells import GridCells as GridCells
from clrecon.mesh.compare.cells import find_mesh_cells as find_mesh_cells
from clrecon.mesh.compare.cells import measure_cells as measure_cells
from clrecon.mesh.compare.cut_cells import find_cut_cells as find_cut_cells
from clrecon.mesh.compare.distances import compare_meshes as compare_meshes
from clrecon.mesh.compare.slices import measure_slices as measure_slices
from clrecon.mesh.compare.truth import measure_truth as measure_truth
from clrecon.mesh.refine.decimation import decimate_mesh as decimate_mesh
from clrecon.mesh.refine.quadric import collapse_quadric as collapse_quadric
from clrecon.mesh.refine.smoothing import smooth_mesh as smooth_mesh
from clrecon.opencl import list_devices
from clrecon.operators import choose_device
from clrecon.operators.filters.bilateral import filter_bilateral as filter_bilateral
from clrecon.operators.filters.denoisers import filter_volume as filter_volume
from clrecon.operators.masks.mask import Mask as Mask
from clrecon.operators.points.bilateral import denoise_points as denoise_points
from clrecon.operators.points.clusters import Clustering as Clustering
from clrecon.operators.points.clusters import cluster_points as cluster_points
from clrecon.operators.points.extract import extract_points as extract_points
from clrecon.operators.points.neighbours import Neighbours as Neighbours
from clrecon.operators.points.neighbours import find_neighbours as find_neighbours
from clrecon.operators.points.normals import estimate_normals as estimate_normals
from clrecon.operators.points.outliers import remove_outliers as remove_outliers
from clrecon.operators.points.reconstruct import reconstruct_surface as reconstruct_surface
from clrecon.operators.points.slice_overlap import find_ghost_slices as find_ghost_slices
from clrecon.operators.points.sparse_cells import remove_sparse_cells as remove_sparse_cells
from clrecon.operators.points.thin import thin_points as thin_points
from clrecon.operators.rays.render import VolumeRenderer as VolumeRenderer
from clrecon.operators.rays.render import render as render
from clrecon.operators.reformat.cut import cut_slice as cut_slice
from clrecon.operators.reformat.cut import reformat_curve as reformat_curve
from clrecon.operators.resident.device_volume import DeviceVolume as DeviceVolume
from clrecon.operators.surface.extract import SurfaceExtractor as SurfaceExtractor
from clrecon.operators.surface.extract import extract_isosurface as extract_isosurface
from clrecon.operators.surface.extract import extract_isosurfaces as extract_isosurfaces
from clrecon.operators.surface.label_masks import extract_label_masks as extract_label_masks
from clrecon.operators.surface.labels import extract_labels as extract_labels
from clrecon.operators.surface.methods import extract_by_method as extract_by_method
from clrecon.operators.vertebrae.inside import VertebraInside as VertebraInside
from clrecon.operators.vertebrae.inside import vertebra_inside as vertebra_inside
from clrecon.operators.vertebrae.solid import vertebra_solid as vertebra_solid
from clrecon.phantom.truth import PhantomTruth as PhantomTruth
from clrecon.phantom.truth import phantom_truth as phantom_truth
from clrecon.points import PointCloud as PointCloud
from clrecon.points import PointStep as PointStep
from clrecon.points import drop_ghost_slices as drop_ghost_slices
from clrecon.points import fill_ghost_slices as fill_ghost_slices
from clrecon.points import keep_clusters as keep_clusters
from clrecon.points.reader import read_points as read_points
from clrecon.reading import list_series as list_series
from clrecon.reading import read_volume as read_volume
from clrecon.rendering import Lighting as Lighting
from clrecon.rendering import Rendering as Rendering
from clrecon.rendering import TransferFunction as TransferFunction
from clrecon.rendering import load_transfer_function as load_transfer_function
from clrecon.rendering.movies.movie import turntable_cameras as turntable_cameras
from clrecon.rendering.movies.movie import write_animation as write_animation
from clrecon.rendering.pictures.likeness import make_control_pictures as make_control_pictures
from clrecon.rendering.pictures.likeness import measure_pictures as measure_pictures
from clrecon.rendering.pictures.mesh_look import MeshLook as MeshLook
from clrecon.rendering.pictures.styles import CurveCut as CurveCut
from clrecon.rendering.pictures.styles import PlaneCut as PlaneCut
from clrecon.rendering.pictures.styles import PointLook as PointLook
from clrecon.rendering.pictures.styles import Projection as Projection
from clrecon.rendering.pictures.styles import SlicesInSpace as SlicesInSpace
from clrecon.rendering.pictures.styles import Style as Style
from clrecon.rendering.pictures.styles import SurfaceLook as SurfaceLook
from clrecon.rendering.pictures.styles import VolumeLook as VolumeLook
from clrecon.rendering.views.camera import Camera as Camera
from clrecon.rendering.views.centre_line_files import read_curve_points as read_curve_points
from clrecon.rendering.views.clip import Clip as Clip
from clrecon.system.time_limit import time_limit as time_limit

__all__: list[str]
__version__: str
device = choose_device
devices = list_devices
