"""Flow on one core in some ten milliseconds: OpenCV's DIS, a fast registration, and how certain the flow is."""
