"""SuperPoint (DeTone et al., CVPRW 2018) with SuperGlue (Sarlin et al., CVPR 2020) or LightGlue, by Hugging Face.

Licence: Magic Leap's weights of SuperPoint and SuperGlue are for noncommercial research by academic or non-profit
organizations only (LICENSE of magicleap/SuperPointPretrainedNetwork and magicleap/SuperGluePretrainedNetwork), also
when Hugging Face or LightGlue pass them on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from kornia.color import rgb_to_grayscale

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.match.base import Matches
from gsfeatloc_ros.match.lightglue import PlacedFeatures
from gsfeatloc_ros.match.peaks import cell_heatmap, centroid
from gsfeatloc_ros.match.tensor import as_tensor, to_matches, to_tensor
from gsfeatloc_ros.match.weights import WeightsError

# Matcher: its class in transformers, and the model on Hugging Face's hub.
_MODELS = {
    "superglue": ("SuperGlueForKeypointMatching", "magic-leap-community/superglue_outdoor"),
    "lightglue": ("LightGlueForKeypointMatching", "ETH-CVG/lightglue_superpoint"),
}
_STRIDE = 8


class SuperPointMatcher:
    """SuperPoint features, matched by a network. Not measured: its weights are not to be had where this was written."""

    upright = True

    def __init__(self, network: str, weights: str, max_features: int, device: str) -> None:
        """Load both networks, which are one model of Hugging Face.

        Args:
            network: superglue or lightglue.
            weights: folder that save_pretrained() wrote or a clone of the hub's, or the name of a model on the hub; ""
                for the authors' on the hub or in its cache.
            max_features: most features taken from an image.
            device: of torch's, on which both run.

        Raises:
            WeightsError: transformers is not installed, or the weights cannot be had or are of other networks.
        """
        class_name, hub_name = _MODELS[network]
        self._network = _load(class_name, str(Path(weights).expanduser()) if weights else hub_name).to(device)
        self._device = device
        self._superpoint = self._network.keypoint_detector
        self._superpoint.keypoint_decoder.max_keypoints = max_features
        self._takes_scores = network == "superglue"

    @torch.inference_mode()
    def features(self, image: Array) -> PlacedFeatures:
        """Extract the features of an RGB image (H, W, 3) uint8."""
        tensor = rgb_to_grayscale(to_tensor(image, self._device, _STRIDE))
        logits = []
        hook = self._superpoint.keypoint_decoder.conv_score_b.register_forward_hook(
            lambda _module, _inputs, output: logits.append(output)
        )
        try:
            found = self._superpoint(tensor)
        finally:
            hook.remove()
        # Given as fractions of the image's size.
        peaks = (found.keypoints[0] * torch.tensor(tensor.shape[:1:-1], device=self._device)).round().long()
        height, width = image.shape[:2]
        inside = ((peaks[:, 0] < width) & (peaks[:, 1] < height)).nonzero()[:, 0]
        return PlacedFeatures(
            centroid(peaks[inside], cell_heatmap(logits[0])),
            found.descriptors[0, inside],
            found.scores[0, inside],
            (width, height),
        )

    @torch.inference_mode()
    def match(self, a: PlacedFeatures, b: PlacedFeatures, same_way_up: bool = False) -> Matches:
        """Match the features of two images."""
        if len(a) == 0 or len(b) == 0:
            return Matches.none()
        keypoints = _pair(as_tensor(a.keypoints), as_tensor(b.keypoints))
        descriptors = _pair(as_tensor(a.descriptors), as_tensor(b.descriptors))
        scores = _pair(as_tensor(a.scores), as_tensor(b.scores))
        mask = _pair(*(torch.ones(len(features), dtype=torch.int32, device=self._device) for features in (a, b)))
        width, height = map(max, a.size, b.size)
        # Of forward(), the part after extraction: it takes images, and would extract the photo's features every time.
        inputs = (keypoints, descriptors, scores) if self._takes_scores else (keypoints, descriptors)
        matches, matching_scores = self._network._match_image_pair(*inputs, height, width, mask=mask)[:2]
        index_b = matches.reshape(2, -1)[0, : len(a)]
        index_a = (index_b >= 0).nonzero().ravel()
        return to_matches(a, b, index_a, index_b[index_a], matching_scores.reshape(2, -1)[0, index_a])


def _pair(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Stack two tensors (N, ...) and (M, ...), the shorter one filled with zeros: (1, 2, max(N, M), ...)."""
    return torch.nn.utils.rnn.pad_sequence([a, b], batch_first=True)[None]


def _load(class_name: str, name: str) -> Any:
    """Load a model of Hugging Face, whose classes are not typed, from a folder, the hub's cache or the hub."""
    try:
        import transformers
        from huggingface_hub.constants import HF_HUB_CACHE
    except ImportError as error:
        raise WeightsError(
            f"{name} needs the package transformers, which is not installed (pip install transformers): {error}"
        ) from error
    try:
        network, report = getattr(transformers, class_name).from_pretrained(name, output_loading_info=True)
    # A hub that cannot be reached, a folder without files and files that are no weights all raise something else.
    except Exception as error:
        raise WeightsError(
            f"no weights {name}: neither a folder (parameter matcher.weights) nor in Hugging Face's cache "
            f"{HF_HUB_CACHE}, and the download failed ({error})"
        ) from error
    if report["missing_keys"]:
        missing = ", ".join(sorted(report["missing_keys"])[:3])
        raise WeightsError(f"the weights {name} are not a {class_name}'s: they lack {missing} ...")
    return network.eval()
