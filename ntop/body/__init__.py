"""The body: skeletons, SMPL-format models, skinning, motions and pose fitting."""
