"""From pixels to metres: control points, homography, camera pose, ground point of a box."""
