"""Read the flow of a pair with OpenEXR alone.

python -m synth generate --n 1 --out data/one
python examples/read_exr.py data/one/samples/000000/flow.exr
"""

import sys

import OpenEXR

with OpenEXR.File(sys.argv[1], separate_channels=True) as file:
    header = dict(file.header())
    planes = {name: channel.pixels for name, channel in file.channels().items()}

for name in sorted(planes):
    print(f"{name:18} {planes[name].dtype} {planes[name].shape}")
for key in sorted(key for key in header if key.startswith("flow.")):
    print(f"{key}: {header[key]}")

# The pixel in column c and row r has its centre at (c + 0.5, r + 0.5); what it shows moves by (U, V) to image 2.
u, v, visible = (planes[f"forward.{part}"] for part in ("U", "V", "visible"))
row, column = u.shape[0] // 2, u.shape[1] // 2
print(f"the centre ({column + 0.5}, {row + 0.5}) of image 1 is at "
      f"({column + 0.5 + u[row, column]:.3f}, {row + 0.5 + v[row, column]:.3f}) of image 2")  # fmt: skip
print(f"{100 * (visible == 1).mean():.1f} % of image 1 is seen in image 2")
