import torch

from hnerf.fields.paper import sample_pdf


def test_fine_samples_by_hand():
    """All weight is in [1, 2], the second of four unit cells: the four samples are 1.125, 1.375, 1.625 and 1.875."""
    middles = torch.tensor([[0.5, 1.5, 2.5, 3.5]])
    weights = torch.tensor([[0.0, 1000.0, 0.0, 0.0]])
    depths = sample_pdf(middles, torch.zeros(1), torch.full((1,), 4.0), weights, torch.full((1, 4), 0.5))
    torch.testing.assert_close(depths, torch.tensor([[1.125, 1.375, 1.625, 1.875]]), atol=1e-3, rtol=0)
