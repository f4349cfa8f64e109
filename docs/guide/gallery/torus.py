"""A torus, measured.

A torus is sampled on voxels of 0.7 x 0.5 x 1.5 mm with a gantry tilted by 12 degrees. The surface is extracted at the
iso value half way between torus and background. Its volume is printed beside the true volume of the torus.
"""

import clrecon
from clrecon.proof.phantom import PhantomSettings, make_phantom

settings = PhantomSettings(kind="torus", size=(128, 96), slices=40, spacing=(0.7, 0.5, 1.5), tilt=12.0)
voxels, affine, truth = make_phantom(settings)
mesh = clrecon.extract_isosurface(clrecon.Volume(voxels, affine), truth["iso_value_hu"])

measured = mesh.quality()
print(f"measured {measured['volume_ml']:.3f} ml, true {truth['surface']['volume_ml']:.3f} ml")
print(f"closed: {measured['closed']}, components: {measured['components']}")

clrecon.render(mesh, view=(30, 40), size=(640, 420)).save("picture.png")
