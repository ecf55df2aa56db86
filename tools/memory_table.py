"""Print what windows of the networks take in memory, as the tables of docs/backbones.md.

python tools/memory_table.py
"""

from __future__ import annotations

from laser_slam.networks.memory import APPETITES, MARGIN, Request

SIZES = {"518x154": (154, 518), "924x266": (266, 924), "518x392": (392, 518)}
NUM_FRAMES = (20, 75)
CARDS_GB = (6, 8, 12, 24)
HELD_GB = 0.7  # that a card's driver and desktop keep


def main() -> None:
    """Print both tables."""
    heads = [f"{name}, {num}" for name in SIZES for num in NUM_FRAMES]
    _row("network", "dtype", "weights", *heads)
    _row(*["---"] * (3 + len(heads)))
    for network, dtype, request in _requests():
        needs = [
            Request(network, size, dtype).window_bytes(num) * MARGIN / 1e9
            for size in SIZES.values()
            for num in NUM_FRAMES
        ]
        weights = f"{request.weights_bytes() / 1e9:.2f}"
        _row(network, dtype, weights, *(f"{need:.2f}" for need in needs))
    print()
    _row("network", "dtype", *(f"{card} GB" for card in CARDS_GB))
    _row(*["---"] * (2 + len(CARDS_GB)))
    for network, dtype, request in _requests():
        frames = [request.largest_window(int((card - HELD_GB) * 1e9)) for card in CARDS_GB]
        _row(network, dtype, *(str(num) if num else "-" for num in frames))


def _requests() -> list[tuple[str, str, Request]]:
    return [
        (network, dtype, Request(network, SIZES["518x154"], dtype))
        for network in APPETITES
        for dtype in ("bfloat16", "float32")
    ]


def _row(*cells: str) -> None:
    print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
