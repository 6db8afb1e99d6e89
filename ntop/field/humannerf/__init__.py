"""HumanNeRF (Weng et al., CVPR 2022, arXiv 2201.04127) as the NToP paper uses it, in plain torch.

The method that the grid is measured against, and a second `train.field` for whoever wants it: a
canonical MLP, a motion-weight volume for the skeletal warp, an MLP for non-rigid motion, patches,
LPIPS + MSE, Adam. Pose correction is left out, as NToP does (its section 3.1). Derived from the two
papers; where the published code is known to be inexact (decision 0004, and rotations by additive
epsilons, a box test that drops rays, a last sample without end), the exact formula is used. Ours:

* decoder widths, Gaussian lengths and the ends of the leaf bones, which the paper leaves open;
* density is a softplus, which cannot start dead, instead of a ReLU;
* the weights' sum is an opacity, so it is held at one where several bones claim a point;
* samples whose opacity is below `weight_floor` whatever the density are left out: they change
  nothing that can be seen and are four fifths of the box.
"""
