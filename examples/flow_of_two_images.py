# %% [markdown]
# Flow between two images with the shipped weights. Each `# %%` is a notebook cell (VS Code, Spyder, jupytext).
#
#     python examples/flow_of_two_images.py before.png after.png

# %%
import sys

import numpy as np
from PIL import Image

import gelflow

image1, image2 = (np.asarray(Image.open(path).convert("RGB")) for path in sys.argv[1:3])  # 8-bit files

# %%
model = gelflow.load_model("best", device="cpu")
flow = model.flow(image1, image2)  # (H, W, 2) float32 px: U to the right, V down
back = model.flow(image2, image1)

# %% The flow and the flow back should cancel; where they do not, trust neither.
rows, columns = np.indices(flow.shape[:2])
there_row = np.clip(np.rint(rows + flow[..., 1]).astype(int), 0, flow.shape[0] - 1)
there_column = np.clip(np.rint(columns + flow[..., 0]).astype(int), 0, flow.shape[1] - 1)
closure = np.linalg.norm(flow + back[there_row, there_column], axis=-1)

# %%
length = np.linalg.norm(flow, axis=-1)
print(f"motion: mean {length.mean():.2f} px, largest {length.max():.2f} px")
print(f"closure: {np.median(closure):.3f} px in the median, above 1 px at {100 * (closure > 1).mean():.1f} %")
