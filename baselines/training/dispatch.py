"""Train one agent, by reinforcement or by supervised learning from the simulator's state."""

from __future__ import annotations

from collections.abc import Callable

from servotrack.baselines.training.jacobian import train_jacobian
from servotrack.baselines.training.marker import train_marker_network
from servotrack.baselines.training.progress import Evaluation
from servotrack.baselines.training.reinforcement import reinforce
from servotrack.baselines.training.run import Entry, TrainingCurve, TrainingRun, TrainingTask
from servotrack.baselines.training.set_prediction import train_set_predictor
from servotrack.baselines.training.student import train_student


def train(
    task: TrainingTask,
    evaluation: Evaluation,
    on_steps: Callable[[int], None] = lambda steps: None,
    on_entry: Callable[[Entry], None] = lambda entry: None,
) -> TrainingCurve:
    """Train one agent, or finish a training that was interrupted.

    After every evaluation the newest policy is in the task's folder as `agent.onnx` with its card. A training that was
    interrupted ends with the same network as one that was not.

    Args:
        task: Environment, settings and seed of the run.
        evaluation: Evaluates the policy during training.
        on_steps: Called with the number of environment steps done.
        on_entry: Called with every evaluation.

    Raises:
        ResultsError: The folder holds another training or cannot be written.
        ValueError: Hyper-parameters that the algorithm does not take, or an environment that it does not support.
    """
    run = TrainingRun(task, evaluation, on_steps, on_entry)
    to_next_checkpoint = {
        "student": train_student,
        "jacobian": train_jacobian,
        "set": train_set_predictor,
        "eyes": train_marker_network,
    }.get(task.settings.algorithm, reinforce)
    while not run.finished:
        to_next_checkpoint(run)
    return run.curve
