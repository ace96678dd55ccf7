"""Estimation from measurements that share errors in groups, some of them outliers.

Treated as independent, thousands of measurements with shared errors of mesh, poses and model would give far too small
standard deviations. The covariance of their gradients is therefore estimated from groups (Liang and Zeger 1986; for
several groupings, Cameron, Gelbach and Miller 2011). It weights the measurements in the fit: the generalised method
of moments (Hansen 1982).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from hsi_sc_nerf.robust_scatter import robust_std

CORRELATED = 8.0
"""Smallest number of measurements that count as one."""
SMALLEST_SCATTER = 0.002


class SharedErrors:
    """Groups of measurements that share errors.

    Args:
        groups: one grouping of the measurements or several: the group of each.
    """

    def __init__(self, *groups: Int[np.ndarray, "m"]) -> None:
        members = [scipy.sparse.csr_array((np.ones(len(group)), (group, np.arange(len(group))))) for group in groups]
        self._groupings, self._by_group = len(groups), scipy.sparse.csr_array(scipy.sparse.vstack(members))

    def information(
        self,
        residual: Float[np.ndarray, "m"],
        jacobian: Float[np.ndarray, "m parameters"],
        precision: Float[np.ndarray, "m"],
    ) -> tuple[Float[np.ndarray, "parameters parameters"], Float[np.ndarray, "parameters"]]:
        """Inverse covariance of the parameters, and its product with the step that fits the measurements best.

        Args:
            residual: measured minus expected values.
            jacobian: derivatives of the expected values.
            precision: inverse variance of each measurement without shared errors.
        """
        weighted = jacobian * precision[:, None]
        alone, sums = weighted.T @ jacobian, self._by_group @ (weighted * residual[:, None])
        spread = CORRELATED * alone + sums.T @ sums
        # For parameters that no measurement depends on yet.
        spread += 1e-9 * np.trace(spread) * np.eye(len(spread))
        known = np.linalg.solve(spread, np.column_stack([alone, sums.sum(axis=0) / self._groupings]))
        return alone @ known[:, :-1], alone @ known[:, -1]

    def significance(
        self,
        residual: Float[np.ndarray, "m"],
        columns: Float[np.ndarray, "m columns"],
        precision: Float[np.ndarray, "m"],
    ) -> Float[np.ndarray, "columns"]:
        """Squared standard deviations by which the best factor of each column exceeds 0; 0 if it is negative."""
        weighted = columns * precision[:, None]
        square = np.maximum((weighted * columns).sum(axis=0), 1e-12)
        factor = np.maximum(weighted.T @ residual / square, 0.0)
        sums = self._by_group @ (weighted * (residual[:, None] - columns * factor))
        spread = CORRELATED * square + (sums**2).sum(axis=0)
        return (factor * square) ** 2 / spread


def scatter_beyond(residual: Float[np.ndarray, "m"], own_std: Float[np.ndarray, "m"]) -> float:
    """Common standard deviation of residuals beyond their own ones; from their median, which is robust to gloss."""
    low, high = SMALLEST_SCATTER, 1.0
    for _ in range(20):
        middle = np.sqrt(low * high)
        if robust_std(residual / np.hypot(middle, own_std)) > 1.0:
            low = middle
        else:
            high = middle
    return float(middle)
