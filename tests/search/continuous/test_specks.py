import numpy as np

from drake_pose.search.continuous.multi_start import without_specks


def shape():
    rows, columns = np.mgrid[:120, :150]
    mask = np.hypot(rows - 60, columns - 70) < 35
    mask[58:62, 20:140] = True
    return mask


def test_clean_masks_stay_as_they_are():
    mask = shape()
    mask[5, 5] = True
    np.testing.assert_array_equal(without_specks(mask), mask)


def test_salt_and_pepper_go():
    generator = np.random.default_rng(1)
    for salt, pepper in ((0.1, 0.0), (0.1, 0.1)):
        chance = generator.random((120, 150))
        noisy = (shape() | (chance < salt)) & (chance < 1.0 - pepper)
        cleaned = without_specks(noisy)
        assert (cleaned ^ shape()).sum() < 0.05 * shape().sum()
        assert (noisy ^ shape()).sum() > 0.2 * shape().sum()


def test_a_mask_of_nothing_but_specks_is_not_emptied():
    mask = np.zeros((50, 60), dtype=bool)
    mask[10, 10] = mask[30, 40] = True
    np.testing.assert_array_equal(without_specks(mask), mask)
