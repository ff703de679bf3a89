"""Equations that cannot be solved are refused in one line."""

from __future__ import annotations

import numpy as np
import pytest

from pdvc.prior import solved


@pytest.mark.parametrize(
    ("matrix", "right", "why"),
    [
        (np.diag([1.0, -1.0, 2.0]), 1.0, "they are not positive definite"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), 1.0, "they are not positive definite"),
        (np.full((4, 4), np.nan), 1.0, ""),
        (np.eye(2), np.nan, "their solution is not finite"),
    ],
)
@pytest.mark.parametrize("columns", [(), (3,)])
def test_what_cannot_be_solved_is_told_in_one_line(matrix, right, why, columns):
    expected = rf"^equations of {len(matrix)} unknowns: cannot be solved for a motion, .*{why}"
    with pytest.raises(ValueError, match=expected) as caught:
        solved(matrix, np.full((len(matrix), *columns), right))
    assert type(caught.value) is ValueError
    assert "\n" not in str(caught.value)


def test_a_system_is_solved_whatever_the_size_of_its_entries():
    rng = np.random.default_rng(0)
    root, scale = rng.normal(size=(5, 5)), 10.0 ** np.array([-12, -3, 0, 4, 9])
    matrix = (root @ root.T + np.eye(5)) * scale[:, None] * scale
    x = rng.normal(size=5) / scale
    np.testing.assert_allclose(solved(matrix, matrix @ x) * scale, x * scale, rtol=1e-9)
