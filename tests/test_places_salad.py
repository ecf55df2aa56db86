"""The descriptor SALAD against the original's outputs, and with a checkpoint of random weights."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import golden
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from views import street_views

from laser_slam.config import PlacesConfig
from laser_slam.dependencies import import_torch
from laser_slam.errors import DependencyError, WeightsError
from laser_slam.networks.dinov2 import EncoderConfig
from laser_slam.networks.salad import Salad, SaladConfig, load_salad, log_transport
from laser_slam.places import PlaceIndex, make_descriptor
from laser_slam.places.salad import SaladDescriptor, squared
from laser_slam.types import Image

MINI = SaladConfig(EncoderConfig(64, 4, 2, resampling="factor"), 8, 16, 32)
MODELS = {"dinov2-salad": SaladConfig(), "mini/dinov2-salad": MINI}


def filled(config: SaladConfig) -> Salad:
    network = Salad(config)
    golden.fill(network)
    return network.eval()


@torch.no_grad()
def taps(network: Salad, case: golden.Case) -> dict[str, Tensor]:
    """Return what the original's outputs are named for, at the places that were kept."""
    seen: dict[str, Tensor] = {}

    def keep(name: str) -> Callable[..., None]:
        def hook(_module: nn.Module, _inputs: object, out: Tensor) -> None:
            seen[name] = out

        return hook

    encoder, aggregator = network.backbone.model, network.aggregator
    modules = {f"block{i}": block for i, block in enumerate(encoder.blocks)}
    modules |= {name: getattr(aggregator, name) for name in ("score", "cluster_features")}
    hooks = [module.register_forward_hook(keep(name)) for name, module in modules.items()]
    descriptor = network(case.images)
    for hook in hooks:
        hook.remove()
    step, stride = case.stride, slice(None, None, case.stride)
    rows, columns = (side // 14 for side in case.images.shape[-2:])
    image, patches = encoder(case.images)
    maps = patches.transpose(1, 2)
    scores, features = seen["score"].flatten(2), seen["cluster_features"].flatten(2)
    transport = log_transport(scores, aggregator.dust_bin)
    found = {
        "pos_embed_c8": encoder.positions(rows, columns)[0, stride, :8],
        "tokens_in_c8": encoder.embed(case.images)[:, stride, :8],
        "blocks_c8": torch.stack([seen[f"block{i}"] for i in range(len(encoder.blocks))])[
            :, :, stride, :8
        ],
        "feature_map": maps.unflatten(2, (rows, columns)),
        "feature_map_c8": maps[:, :8, stride],
        "cls_token": image,
        "score_logits": scores[:, ::8, stride],
        "cluster_features": features[:, ::16, stride],
        "token_features": aggregator.token_features(image),
        "log_assignment_with_dustbin": transport[:, ::8, stride],
        "descriptor": descriptor,
    }
    if step == 1 and "feature_map" in case.expected:
        found["score_logits"] = seen["score"]
    return {key: found[key] for key in case.expected}


def differences(model: str, name: str, network: Salad) -> dict[str, float]:
    case = golden.load_case(model, name)
    found = taps(network, case)
    return {key: golden.relative_difference(found[key], case.expected[key]) for key in found}


@pytest.fixture(scope="module")
def mini() -> Salad:
    return filled(MINI)


@pytest.mark.parametrize("model", MODELS)
def test_keys_shapes_and_drawn_weights_are_those_of_the_original(model: str) -> None:
    with torch.device("meta"):
        ours = {k: list(v.shape) for k, v in Salad(MODELS[model]).state_dict().items()}
    manifest = golden.load_manifest(model)
    ours["backbone.model.mask_token"] = [1, MODELS[model].encoder.width]
    assert ours == manifest["shapes"]
    prints = {key: golden.fingerprint(key, ours[key]) for key in manifest["fingerprints"]}
    assert prints == manifest["fingerprints"]


@pytest.mark.parametrize("name", ["a", "b"])
def test_the_tiny_network_says_what_the_original_says(mini: Salad, name: str) -> None:
    found = differences("mini/dinov2-salad", name, mini)
    assert len(found) == 4
    assert max(found.values()) < golden.TOLERANCE, found


@pytest.mark.slow
def test_the_full_network_says_what_the_original_says() -> None:
    network = filled(SaladConfig())
    for name in "abcd":
        found = differences("dinov2-salad", name, network)
        assert len(found) == 10
        assert max(found.values()) < golden.TOLERANCE, (name, found)
    network.to(torch.bfloat16)
    for name in "abcd":
        case = golden.load_case("dinov2-salad", name)
        with torch.no_grad():
            cosines = (network(case.images).numpy() * case.expected["descriptor"]).sum(axis=1)
        assert np.all((cosines > 0.9999) & (cosines < 1 - 1e-7)), (name, cosines)


def test_transport_is_that_of_the_original() -> None:
    with np.load(golden.DATA / "transport.npz", allow_pickle=False) as file:
        scores, dust_bin = (
            torch.from_numpy(file[f"sinkhorn_{key}"]) for key in ("scores", "dustbin")
        )
        expected = file["sinkhorn_log_out"]
    assert golden.relative_difference(log_transport(scores, dust_bin), expected) < 1e-6


def test_every_patch_is_shared_out_whole() -> None:
    scores = torch.from_numpy(golden.make_weights("scores.weight", [2, 8, 30])) * 20
    shares = log_transport(scores, torch.tensor(1.0)).exp()
    torch.testing.assert_close(shares.sum(dim=1), torch.ones(2, 30), rtol=0, atol=1e-5)


def test_more_clusters_than_patches_are_refused(mini: Salad) -> None:
    with pytest.raises(ValueError, match="6 patches for 8 clusters: the image is too small"):
        mini(torch.zeros(1, 3, 28, 42))


@pytest.mark.parametrize("how", ["weights", "autocast"])
def test_half_precision_gives_nearly_the_same_vector(how: str) -> None:
    """The cosine of two looks at a place is told to a hundredth."""
    case = golden.load_case("mini/dinov2-salad", "a")
    network = filled(MINI).to(torch.bfloat16 if how == "weights" else torch.float32)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=how == "autocast"):
        found = network(case.images)
    assert found.dtype == torch.float32
    cosines = (found.numpy() * case.expected["descriptor"]).sum(axis=1)
    assert np.all((cosines > 0.998) & (cosines < 1 - 1e-7))


@pytest.mark.parametrize("size", ["1241x376", "480x640"])
def test_images_are_squared_as_the_original_does_it(size: str) -> None:
    width, height = map(int, size.split("x"))
    image = np.floor(golden.make_images(21, 1, height, width)[0] * 255 + 0.5).astype(np.uint8)
    found = squared(np.ascontiguousarray(image.transpose(1, 2, 0)), 336)
    with np.load(golden.DATA / "squares.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(found.transpose(2, 0, 1)[:, ::7, ::7], file[size])


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A checkpoint with the released one's keys and shapes, and random numbers."""
    path = tmp_path_factory.mktemp("salad") / "dino_salad.ckpt"
    torch.save(golden.make_tensors(golden.load_manifest("dinov2-salad")["shapes"]), path)
    yield path
    path.unlink()  # 352 MB, that pytest would keep


@pytest.fixture(scope="module")
def descriptor(weights: Path) -> SaladDescriptor:
    config = PlacesConfig(descriptor="salad", salad_weights=str(weights), salad_size=126)
    found = make_descriptor(config)
    assert isinstance(found, SaladDescriptor)
    return found


def test_the_descriptor_is_the_network_on_the_squared_image(
    descriptor: SaladDescriptor, weights: Path
) -> None:
    image = street_views()[0]
    pixels = torch.from_numpy(squared(image, 126)).permute(2, 0, 1)[None] / 255
    with torch.no_grad():
        expected = load_salad(str(weights))(pixels)[0].numpy()
    found = descriptor.describe(image)
    assert found.dtype == np.float32
    assert found.shape == (descriptor.size,) == (8448,)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert float(np.linalg.norm(found)) == pytest.approx(1, abs=1e-5)
    np.testing.assert_array_equal(descriptor.describe(image), found)


def test_the_descriptor_may_compute_in_half_precision(
    descriptor: SaladDescriptor, weights: Path
) -> None:
    config = PlacesConfig(salad_weights=str(weights), salad_size=126, salad_dtype="bfloat16")
    image = street_views()[0]
    cosine = float(SaladDescriptor(config).describe(image) @ descriptor.describe(image))
    assert 0.9999 < cosine < 1 - 1e-7


def test_another_look_at_a_view_is_found_among_others(descriptor: SaladDescriptor) -> None:
    """Even random weights keep what an image is made of: a darker, noisier one is nearest."""
    views = street_views()[::4]
    index = PlaceIndex(descriptor.size)
    index.insert(np.stack([descriptor.describe(view) for view in views]))
    for position, view in enumerate(views):
        nearest, _ = index.query(descriptor.describe(_in_other_light(view)), 1)
        assert nearest[0] == position


def _in_other_light(image: Image) -> Image:
    noise = np.random.default_rng(0).normal(scale=3, size=image.shape)
    return np.asarray(np.clip(0.95 * image + noise, 0, 255), np.uint8)


def test_an_image_of_one_colour_has_no_description(descriptor: SaladDescriptor) -> None:
    for shape in ((48, 64, 3), (10, 10, 3)):
        image = np.empty(shape, np.uint8)
        image[:] = (10, 200, 30)
        assert not descriptor.describe(image).any()
        image[0, 0] = 0
        assert descriptor.describe(image).any()


def test_missing_weights_are_told_with_where_to_get_them() -> None:
    with pytest.raises(WeightsError) as caught:
        make_descriptor(PlacesConfig(descriptor="salad"))
    assert str(caught.value) == (
        "places.salad_weights: not set; download dino_salad.ckpt (352 MB, GPL-3.0) from "
        "https://github.com/serizba/salad/releases/download/v1.0.0/dino_salad.ckpt "
        "and give its path"
    )


def test_weights_of_another_network_are_told_by_their_keys(tmp_path: Path) -> None:
    path = tmp_path / "dinov2_vitb14_pretrain.pth"
    torch.save({"cls_token": torch.zeros(1, 1, 768)}, path)
    config = PlacesConfig(descriptor="salad", salad_weights=str(path))
    with pytest.raises(WeightsError, match=r"is no dino_salad\.ckpt: 187 missing \(backbone\."):
        make_descriptor(config)


def test_a_missing_torch_is_told_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import_torch.cache_clear()
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(DependencyError, match=r"PyTorch .* pip install 'laser-slam\[networks\]'"):
        make_descriptor(PlacesConfig(descriptor="salad", salad_weights="any"))
