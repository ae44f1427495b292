"""Image-space refinement: the rendered links against masks, features and tracks, by gradient descent in torch.

For scenes whose masks and meshes were made by other means than the tracks (a segmentation model, an image-to-3D model,
by hand). The masks and meshes of the default path are cut by the joint itself, so they hold no new evidence about it.
"""

from reconstruct.refine.coverage import Mesh
from reconstruct.refine.joint import Refinement, moved, refine_joint

__all__ = ["Mesh", "Refinement", "moved", "refine_joint"]
