"""One joint from tracks with depth."""

from reconstruct.joint.rigid.fit import fit_rigid

__all__ = ["fit_rigid"]
