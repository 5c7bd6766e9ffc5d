# SPDX-License-Identifier: Apache-2.0
"""Identity losses in torch float64: the oracle of ``kernels.identity`` and ``kernels.identity_kl``."""

from __future__ import annotations

import math

import torch


def cross_entropy(
    identity: torch.Tensor, labels: torch.Tensor, weights: torch.Tensor, biases: torch.Tensor
) -> torch.Tensor:
    """Return mean CE(W e + b, y) / log(classes) over all pixels (GG-SLAM eq. 8).

    Args:
        identity: [16, H, W].
        labels: [H, W] int; outside [0, classes): ignored.
        weights: [classes, 16]; biases: [classes].
    """
    classes = weights.shape[0]
    if classes < 2:
        return 0.0 * (identity.sum() + weights.sum() + biases.sum())
    logits = torch.einsum("ck,khw->hwc", weights, identity) + biases
    valid = (labels >= 0) & (labels < classes)
    index = torch.where(valid, labels, 0).long()
    log_p = torch.log_softmax(logits, -1).gather(-1, index[..., None])[..., 0]
    return -torch.where(valid, log_p, 0.0).sum() / (labels.numel() * math.log(classes))


def neighbour_divergence(
    identities: torch.Tensor,
    samples: torch.Tensor,
    neighbours: torch.Tensor,
    weights: torch.Tensor,
    biases: torch.Tensor,
) -> torch.Tensor:
    """Return mean KL(P_j || Q_jk) / classes over samples j and neighbours k (eqs. 9-10).

    Args:
        identities: [n, 16].
        samples: [S] index of each sampled Gaussian; neighbours: [S, k]; negative: adds nothing.
        weights: [classes, 16]; biases: [classes].
    """
    log_p = torch.log_softmax(identities @ weights.T + biases, -1)
    n = identities.shape[0]
    valid = (samples >= 0) & (samples < n)
    valid = valid[:, None] & (neighbours >= 0) & (neighbours < n)
    p = log_p[torch.where((samples >= 0) & (samples < n), samples, 0).long()][:, None]
    q = log_p[torch.where(valid, neighbours, 0).long()]
    divergence = (p.exp() * (p - q)).sum(-1)
    return torch.where(valid, divergence, 0.0).sum() / (max(valid.numel(), 1) * weights.shape[0])
