"""Labels of rendered views: keypoints, visibility, boxes, areas. Reads images, never the avatar."""
