"""A point cloud, filtered.

The points are the voxels at the surface of the region of 200 HU and more. Density-based clustering separates the
vertebrae. The largest cluster is kept and thinned to one point in each cube of 2 mm.
"""

import clrecon
from clrecon.proof.phantom import PhantomSettings, make_phantom

voxels, affine, _ = make_phantom(PhantomSettings(levels="L1-L3", size=(160, 160), spacing=(1.2, 1.2, 1.2)))
cloud = clrecon.extract_points(clrecon.Volume(voxels, affine), hu=(200, None), kind="shell")

clusters = clrecon.cluster_points(cloud, eps=2.0, min_samples=6)
vertebra = clrecon.keep_clusters(clusters.cloud, "largest")
few = clrecon.thin_points(vertebra.cloud, 2.0)
print(f"{len(cloud)} points, {len(vertebra.cloud)} of one vertebra, {len(few.cloud)} after thinning")

clrecon.render(few.cloud, view=(35, 15), size=(640, 420)).save("picture.png")
