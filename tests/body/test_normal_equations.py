import numpy as np
import pytest

from hnerf.body.normal_equations import NormalEquations


def random_problem(frames: int, unknowns: int, shared: int) -> tuple[NormalEquations, np.ndarray, np.ndarray]:
    """Return the banded form, the dense matrix and the dense gradient of the same random least-squares problem."""
    generator = np.random.default_rng(0)
    size = frames * unknowns
    jacobian = np.zeros((frames * 40, size + shared))
    for t in range(frames):  # each row involves at most three neighbouring frames
        low, high = t * unknowns, min(t + 3, frames) * unknowns
        jacobian[t * 40 : (t + 1) * 40, low:high] = generator.normal(size=(40, high - low))
    jacobian[:, size:] = generator.normal(size=(len(jacobian), shared))
    dense, gradient = jacobian.T @ jacobian, jacobian.T @ generator.normal(size=len(jacobian))
    equations = NormalEquations(frames, unknowns, shared)
    blocks = dense[:size, :size].reshape(frames, unknowns, frames, unknowns).swapaxes(1, 2)
    for k in range(3):
        for t in range(frames - k):
            equations.frame[k][t] = blocks[t, t + k]
    equations.border[:] = dense[:size, size:].reshape(frames, unknowns, shared)
    equations.shared[:] = dense[size:, size:]
    equations.frame_gradient[:], equations.shared_gradient[:] = gradient[:size].reshape(frames, -1), gradient[size:]
    return equations, dense, gradient


@pytest.mark.parametrize(("frames", "damping"), [(6, 0.0), (1, 0.0), (4, 0.5)])
def test_the_banded_step_matches_the_dense_solution(frames: int, damping: float) -> None:
    """This includes a single frame, without neighbours. Damping scales the diagonal without the coupling between
    frames."""
    equations, dense, gradient = random_problem(frames, 4, 2)
    equations.coupling_diagonal[:] = 5.0
    frame, shared = equations.step(damping, np.full(2, -np.inf), np.full(2, np.inf))
    coupling = np.append(np.full(4 * frames, 5.0), [0, 0])
    damped = dense + damping * np.diag(np.diag(dense) - coupling)
    np.testing.assert_allclose(np.append(frame, shared), -np.linalg.solve(damped, gradient), atol=1e-10)


def test_a_shared_unknown_stops_at_its_bound_and_the_others_are_optimal() -> None:
    equations, dense, gradient = random_problem(4, 2, 2)
    wanted = -np.linalg.solve(dense, gradient)[-2]
    bounds = np.array([[-np.inf] * 2, [np.inf] * 2])
    bounds[int(wanted > 0), 0] = wanted / 2
    frame, shared = equations.step(0.0, *bounds)
    np.testing.assert_allclose(shared[0], wanted / 2)
    rest = np.delete(np.arange(10), 8)
    best = np.linalg.solve(dense[np.ix_(rest, rest)], -gradient[rest] - dense[rest, 8] * wanted / 2)
    np.testing.assert_allclose(np.append(frame, shared[1]), best, atol=1e-10)
