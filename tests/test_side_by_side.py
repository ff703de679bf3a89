"""Images computed side by side: handed out in order, a few ahead, and never silently lost."""

import numpy as np
import pytest

from simulator.side_by_side import in_order


def test_images_are_made_only_a_few_ahead():
    made = []

    def make(index):
        made.append(index)
        return np.full((1, 1), index, dtype=np.uint16)

    for index, image in in_order(make, range(40), 2):
        assert image[0, 0] == index
        assert len(made) <= index + 5
    assert sorted(made) == list(range(40))


def test_an_error_in_one_image_surfaces():
    def fail(index):
        raise RuntimeError(f"image {index}")

    with pytest.raises(RuntimeError, match="image 0"):
        list(in_order(fail, range(3), 2))
