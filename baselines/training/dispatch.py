"""Training of one agent, by reinforcement or from what is known in training."""

from __future__ import annotations

from collections.abc import Callable

from servotrack.baselines.training.jacobian import train_jacobian
from servotrack.baselines.training.marker import train_marker_network
from servotrack.baselines.training.progress import PeriodicEvaluation
from servotrack.baselines.training.reinforcement import reinforce
from servotrack.baselines.training.run import Entry, TrainingCurve, TrainingRun, TrainingTask
from servotrack.baselines.training.set_prediction import train_set_predictor
from servotrack.baselines.training.student import train_student


def train(
    task: TrainingTask,
    evaluation: PeriodicEvaluation,
    on_steps: Callable[[int], None] = lambda steps: None,
    on_entry: Callable[[Entry], None] = lambda entry: None,
) -> TrainingCurve:
    """Train one agent, or finish a training that was interrupted.

    The newest policy lies in the task's folder as `agent.onnx` with its card, always one that works.

    Args:
        task: What to do.
        evaluation: Measures the policy as it goes.
        on_steps: Called with the environment steps so far.
        on_entry: Called with every measurement.

    Raises:
        ResultsError: The folder holds another training or cannot be written.
        ValueError: Hyper-parameters that the algorithm does not take, or an environment that it cannot learn in.
    """
    run = TrainingRun(task, evaluation, on_steps, on_entry)
    if not run.finished:
        {"student": train_student, "jacobian": train_jacobian, "set": train_set_predictor, "eyes": train_marker_network}.get(
            task.settings.algorithm, reinforce
        )(run)
    return run.curve
