"""Person mattes and 2D keypoints: the MediaPipe pose network, background subtraction, polygons."""
