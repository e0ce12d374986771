"""Flow and markers of a camera at its own rate, a line for each frame.

python examples/camera_loop.py 0            # a camera's number
python examples/camera_loop.py video.mp4    # or a video
"""

import sys

import cv2
import numpy as np

import gelflow

source = sys.argv[1]
camera = cv2.VideoCapture(int(source) if source.isdecimal() else source)
decoded, frame = camera.read()
if not decoded:
    sys.exit(f"{source}: gives no frame")
# OpenCV's frames are BGR; the gel should be at rest. No frame waits for a network.
tracker = gelflow.Tracker(frame[..., ::-1], wait=False)
number = 0
while True:
    decoded, frame = camera.read()
    if not decoded:
        break
    number += 1
    found = tracker.update(frame[..., ::-1])
    known = found.sigma < 1
    motion = np.hypot(found.flow[..., 0], found.flow[..., 1])[known].mean() if known.any() else np.nan
    seen = found.markers["visible"].sum()
    print(
        f"frame {number}: mean motion {motion:.2f} px, {seen} of {len(found.markers)} markers seen, "
        f"{1e3 * found.seconds:.0f} ms"
    )
camera.release()
