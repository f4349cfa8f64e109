"""One mesh for each vertebra of a label map.

The label selects the cells and the HU place the vertices, so the meshes do not show the voxel steps of the label map.
`clrecon.read_labels` reads label maps of other programs in the same way as that of the phantom.
"""

import clrecon
from clrecon.proof.phantom import PhantomSettings, write_phantom

write_phantom("spine", PhantomSettings(levels="L1-L3", size=(160, 160), spacing=(1.2, 1.2, 1.2)))
volume = clrecon.read_volume("spine")
labels = clrecon.read_labels("spine/levels.nrrd")

for number, mesh in clrecon.extract_labels(volume, labels, 226).items():
    print(f"{labels.names[number]}: {mesh.quality()['volume_ml']:.1f} ml")
    mesh.save(f"{labels.names[number]}.stl")

picture = clrecon.render(volume, mode="surface", labels=labels, view=(60, 15), size=(640, 420))
picture.save("picture.png")
