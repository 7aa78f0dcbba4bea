"""The harmonic extension into a hole: its values stay in the range of the known pixels and near the exact solution."""

import numpy as np
import pytest
import torch
from scenes import images
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve

from reffusion.prior.harmonic_fill import harmonic_extension


def disk_tensor(height, width, radius):
    return torch.from_numpy(images.disk_mask((height, width), height / 2, width / 2, radius))[None, None].double()


def signed_random_images(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1


def smooth_image(height, width):
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    return torch.stack([x, torch.sin(2 * y), x * y])[None].double()


def solve_laplace(image, hole):
    """Return the image [H, W, K] with Laplace's equation solved in the hole, by a sparse direct solver.

    Known pixels are Dirichlet boundary values; at the border of the image the normal derivative is zero.
    """
    height, width = hole.shape
    number = -np.ones(hole.shape, int)
    number[hole] = np.arange(hole.sum())
    rows, columns, values, right = [], [], [], np.zeros((hole.sum(), image.shape[2]))
    for y, x in np.argwhere(hole):
        here = number[y, x]
        for ny, nx in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            if not (0 <= ny < height and 0 <= nx < width):
                continue
            rows.append(here), columns.append(here), values.append(1.0)
            if hole[ny, nx]:
                rows.append(here), columns.append(number[ny, nx]), values.append(-1.0)
            else:
                right[here] += image[ny, nx]
    done = image.copy()
    done[hole] = spsolve(csr_matrix((values, (rows, columns))), right)
    return done


@pytest.mark.parametrize("size", [(64, 64), (37, 51), (1, 9), (1, 1)])
def test_known_pixels_stay_and_the_hole_lies_within_their_range(size):
    images, hidden = signed_random_images(3, 3, *size), (signed_random_images(3, 1, *size, seed=1) > 0).double()
    hidden[..., 0, 0] = 0
    filled = harmonic_extension(images, hidden)
    known = (hidden == 0).expand_as(images)
    assert torch.equal(filled[known], images[known])
    low = images.where(known, torch.inf).amin((2, 3), keepdim=True)
    high = images.where(known, -torch.inf).amax((2, 3), keepdim=True)
    assert bool(((filled >= low - 1e-12) & (filled <= high + 1e-12)).all())


def test_a_constant_is_continued_exactly():
    images = torch.full((1, 3, 40, 40), 0.3, dtype=torch.float64)
    assert (harmonic_extension(images, disk_tensor(40, 40, 15)) - 0.3).abs().max() < 1e-14


@pytest.mark.parametrize("radius", [3, 8, 16])
def test_it_is_close_to_the_solution_of_laplaces_equation(radius):
    images, hidden = smooth_image(48, 48), disk_tensor(48, 48, radius)
    hole = hidden[0, 0].numpy() > 0
    solution = solve_laplace(images[0].permute(1, 2, 0).numpy(), hole)
    ours = harmonic_extension(images, hidden)[0].permute(1, 2, 0).numpy()
    assert np.abs(ours - solution)[hole].max() < 0.12  # values range from -1 to 1
    assert np.square(ours - solution)[hole].mean() < 0.01 * np.square(solution)[hole].mean() + 2e-4


def test_the_content_of_the_hole_does_not_matter():
    images, hidden = signed_random_images(1, 3, 32, 32), disk_tensor(32, 32, 9)
    other = torch.where(hidden > 0, torch.nan, images)
    assert torch.equal(harmonic_extension(images, hidden), harmonic_extension(other, hidden))


def test_nothing_given_gives_gray_and_leaves_its_neighbors_in_the_batch_alone():
    images, hidden = signed_random_images(2, 3, 32, 32), disk_tensor(32, 32, 9).repeat(2, 1, 1, 1)
    hidden[0] = 1
    both = harmonic_extension(images, hidden)
    assert torch.equal(both[0], torch.zeros_like(both[0]))
    assert torch.equal(both[1], harmonic_extension(images[1:], hidden[1:])[0])


def test_no_hole_changes_nothing():
    images = signed_random_images(1, 3, 20, 30)
    assert torch.equal(harmonic_extension(images, torch.zeros(1, 1, 20, 30, dtype=torch.float64)), images)
