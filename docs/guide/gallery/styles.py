"""One spine in four styles.

The volume stays on the device. The four pictures are volume rendering with the preset "spine", a shaded surface, a
maximum intensity projection, and a simulated radiograph.
"""

import numpy as np
from PIL import Image

import clrecon
from clrecon.proof.phantom import PhantomSettings, make_phantom

voxels, affine, _ = make_phantom(PhantomSettings(levels="L1-L3", size=(160, 160), spacing=(1.2, 1.2, 1.2)))
size = (320, 240)

with clrecon.VolumeRenderer(clrecon.Volume(voxels, affine)) as renderer:
    tiles = [
        renderer.render(preset="spine", view=(35, 15), size=size).annotated(caption="preset spine"),
        renderer.render(mode="surface", view=(35, 15), size=size).annotated(caption="surface"),
        renderer.render(mode="mip", view=(35, 15), size=size).annotated(caption="brightest value"),
        renderer.render(preset="x-ray", size=size).annotated(caption="radiograph"),
    ]

pictures = [tile.image[..., :3] for tile in tiles]
sheet = np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])])
Image.fromarray(sheet).save("picture.png")
