"""Rotations, rigid transforms, cameras and rigs: pure torch, no files, no images."""
