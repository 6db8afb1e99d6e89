"""Scores: images, 2D keypoints, 3D joints, dataset statistics; pure numpy, one definition each."""
