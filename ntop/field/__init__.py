"""Avatars: a canonical voxel radiance field, warped to each pose, marched along camera rays."""
