"""ONNX: the exported network answers as the network itself does; refusals."""

from pathlib import Path

import numpy as np
import pytest
import torch
from test_cli import fails

from gelflow.cli import main
from gelflow.config import ModelConfig
from gelflow.models import GelFlow
from gelflow.models.weights import load_weights, save_weights
from gelflow.ops.correlation import _unfolded, local_correlation


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    network = GelFlow(ModelConfig(levels=4, projected_channels=8, refine="half", refine_iterations=1))
    with torch.no_grad():  # a fresh network sees next to no motion: let the heads answer a hundred times as strongly
        for name, value in network.named_parameters():
            if "head.weight" in name:
                value *= 100
    save_weights(tmp_path / "weights.safetensors", network)
    return tmp_path / "weights.safetensors"


def test_both_forms_of_the_correlation_agree() -> None:
    """The exported graph holds another form."""
    first, second = torch.rand(2, 2, 5, 7, 9, dtype=torch.float64)
    torch.testing.assert_close(local_correlation(first, second, 3), _unfolded(first, second, 3), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_the_exported_network_gives_the_same_flow(weights: Path, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    pytest.importorskip("onnxscript", reason="onnxscript is not installed")
    out = tmp_path / "new" / "flow.onnx"
    for _ in range(2):  # the second time in place of the first file
        assert main(["export", str(weights), "--out", str(out), "--size", "67x74"]) == 0
    images = torch.rand(2, 1, 3, 67, 74).unbind()
    session = runtime.InferenceSession(str(out))
    (flow,) = session.run(["flow"], {f"image{k + 1}": image.numpy() for k, image in enumerate(images)})
    with torch.no_grad():
        expected = load_weights(weights)(*images)[0].numpy()
    assert np.abs(expected).max() > 0.1
    # float32 sums in another order: 1e-6 of the largest flow per convolution, some 30 of them.
    np.testing.assert_allclose(flow, expected, atol=3e-5 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("tail", "word"),
    [
        (["--out", "x.onnx"], "was trained on images of any size"),
        (["--out", "x.pt", "--size", "64x64"], "ending in .onnx"),
        (["--out", "x.onnx", "--size", "32x64"], "at least 64 px"),
        (["--out", "x.onnx", "--size", "big"], "ROWSxCOLUMNS"),
        (["--out", "other.onnx", "--size", "64x64"], "other.onnx: exists and does not come from this command"),
        (["--out", "x.onnx", "--size", "64x64"], "pip install onnx onnxscript"),
    ],
)
def test_mistakes_are_one_line(
    weights: Path, tail: list[str], word: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gelflow.models.onnx.find_spec", lambda name: None if "pip" in word else name)
    monkeypatch.chdir(weights.parent)
    Path("other.onnx").write_text("another's")
    assert word in fails(capsys, "export", weights.name, *tail)
    assert sorted(path.name for path in weights.parent.iterdir()) == ["other.onnx", weights.name]
    assert Path("other.onnx").read_text() == "another's"
