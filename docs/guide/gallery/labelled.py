"""Vertebrae by label, each in its colour.

The label selects the cells and HU place the vertices, so the meshes have no steps of the mask. The labels are those of
the phantom; a map of another program is read in the same way.
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
