"""Feed WebDataset shards to a torch DataLoader, and score the shipped network on them.

python -m synth generate --n 8 --out data/demo
python -m synth export data/demo --format webdataset --out data/shards
python examples/dataloader.py data/shards
"""

import sys

import torch
from torch.utils.data import DataLoader

import gelflow

# A PairDataset reads shards, a dataset of synth, or a folder that `gelflow pairs` wrote; pairs come in any order.
pairs = gelflow.PairDataset(sys.argv[1])
loader = DataLoader(pairs, batch_size=2, shuffle=True, generator=torch.Generator().manual_seed(0))
model = gelflow.load_model("best", device="cpu")

errors, motions = [], []
for batch in loader:
    image1, image2, truth = batch["image1"], batch["image2"], batch["flow"]  # (B, 3, H, W), (B, 3, H, W), (B, 2, H, W)
    found = model.flow(image1, image2)
    counts = torch.isfinite(truth).all(dim=1)  # NaN where a pixel sees no gel
    errors.append((found - truth).norm(dim=1)[counts])
    motions.append(truth.norm(dim=1)[counts])
    print(f"{', '.join(batch['name'])}: endpoint error {errors[-1].mean():.3f} px")
print(f"mean endpoint error {torch.cat(errors).mean():.3f} px of {torch.cat(motions).mean():.3f} px of motion")
