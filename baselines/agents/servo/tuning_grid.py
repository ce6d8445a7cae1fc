"""Values that `servotrack tune` tries for the servo agents, and the agents that borrow values from others.

Every grid holds the estimator's default. Steps are factors of two where only the order of magnitude matters, finer for
probabilities. Exploratory moves, supervisor and control laws are common to all agents and are not searched.
"""

from __future__ import annotations

from collections.abc import Mapping

Grid = Mapping[str, tuple[float, ...]]

GRIDS: Mapping[str, Grid] = {
    "broyden": {
        "rate": (0.25, 0.35, 0.5, 0.7, 1.0),
        "time_weight": (0.5, 1.0, 2.0, 4.0, 8.0),
        "damping": (0.0015, 0.003, 0.006, 0.012, 0.024),
    },
    "rls": {
        "forgetting": (0.7, 0.8, 0.85, 0.9, 0.95, 0.98),
        "measurement_noise": (0.75, 1.5, 3.0, 6.0, 12.0),
        "prior.joint_spread": (150.0, 300.0, 600.0),
        "prior.time_spread": (100.0, 200.0, 400.0, 800.0),
    },
    "kf": {
        "walk.joint_noise": (1.25, 2.5, 5.0, 10.0, 20.0),
        "walk.time_noise": (10.0, 20.0, 40.0, 80.0, 160.0),
        "measurement_noise": (0.75, 1.5, 3.0, 6.0, 12.0),
        "prior.joint_spread": (150.0, 300.0, 600.0),
        "prior.time_spread": (100.0, 200.0, 400.0),
    },
    "student-t-kf": {"outliers.degrees_of_freedom": (1.0, 2.0, 4.0, 8.0, 16.0)},
    "correntropy-kf": {"outliers.bandwidth": (1.0, 1.5, 2.0, 3.0, 5.0)},
    "pf": {
        "walk.joint_noise": (2.5, 5.0, 10.0),
        "walk.time_noise": (20.0, 40.0, 80.0),
        "measurement_noise": (1.5, 3.0, 6.0),
        "kernel": (0.0, 0.5, 1.0),
        "resample_below": (0.25, 0.5, 0.75),
    },
    "level-kf": {
        "walk.joint_noise": (1.5, 3.0, 6.0, 12.0, 24.0),
        "walk.time_noise": (5.0, 10.0, 20.0, 40.0, 80.0),
        "pixel_noise": (0.25, 0.5, 1.0, 2.0, 4.0),
        "curvature_noise": (0.05, 0.1, 0.2, 0.4, 0.8),
    },
    "parametric-ekf": {
        "estimator.jerk": (0.075, 0.15, 0.3, 0.6, 1.2),
        "estimator.drift": (0.0003, 0.00055, 0.0011, 0.0022, 0.0044),
        "estimator.pixel_noise": (0.275, 0.55, 1.1),
        "estimator.encoder_noise": (0.0002, 0.0004, 0.0008),
        "estimator.optics_error": (0.03, 0.06, 0.12),
        "estimator.scale_spread": (0.2, 0.4, 0.8),
    },
    "parametric-ukf": {"estimator.kappa": (-4.0, 0.0, 4.0)},
    "lifted-kf": {
        "models.0.jerk": (15.0, 30.0, 60.0, 120.0, 240.0),
        "models.1.jerk": (50.0, 100.0, 200.0, 400.0, 800.0),
        "models.1.jump": (50.0, 100.0, 200.0, 400.0, 800.0),
        "model_stay": (0.95, 0.98, 0.99),
        "noise_stay": (0.97, 0.985, 0.9925),
        "encoder_noise": (0.0004, 0.0008, 0.0016),
        "optics_error": (0.0125, 0.025, 0.05),
        "outlier_rate": (0.0075, 0.015, 0.03),
        "drift": (0.075, 0.15, 0.3),
    },
    "lifted-kf-swinging": {
        "models.0.jerk": (4.0, 8.0, 16.0),
        "models.1.jerk": (4.0, 8.0, 16.0),
        "models.2.jerk": (4.0, 8.0, 16.0),
        "models.3.jerk": (57.5, 115.0, 230.0),
        "models.4.jump": (250.0, 500.0, 1000.0),
    },
}
"""Values tried, by agent and path into its estimator."""

UNSTAMPED_GRIDS: Mapping[str, Grid] = {
    "latency-bank-agile-kf": {
        "estimator.models.0.jump": (5.0, 10.0, 20.0, 40.0),
        "estimator.models.0.jerk": (2.5, 10.0, 40.0),
        "estimator.models.1.jump": (50.0, 100.0, 200.0),
        "estimator.models.1.jerk": (2.5, 10.0, 40.0),
        "estimator.models.2.jump": (300.0, 600.0, 1200.0),
        "estimator.models.2.jerk": (2.5, 10.0, 40.0),
        "estimator.models.0.damping": (2.5, 10.0, 40.0),
        "estimator.model_stay": (0.85, 0.9, 0.95, 0.98, 0.99),
        "hypotheses.ages.0": (0.0, 0.01, 0.02),
        "hypotheses.ages.1": (0.05, 0.06, 0.07),
        "hypotheses.ages.2": (0.1, 0.11, 0.12),
        "estimator.drift": (0.075, 0.15, 0.3, 0.6),
        "estimator.optics_error": (0.00625, 0.0125, 0.025, 0.05),
        "estimator.encoder_noise": (0.0004, 0.0008, 0.0016),
        "estimator.outlier_rate": (0.0075, 0.015, 0.03),
        "estimator.noise_stay": (0.97, 0.985, 0.9925),
        "law.gain": (0.6, 0.7, 0.8, 0.9, 1.0),
        "law.max_step": (0.1, 0.15, 0.2, 0.3),
        "excitation.steps": (2, 4, 6),
        "excitation.amplitude": (0.02, 0.03, 0.04, 0.06),
    },
}
"""Values tried at level 6, where frames are late and unstamped; law and exploratory moves are searched, too."""

BORROWED: Mapping[str, str] = {
    "fixed-jacobian": "kf",
    "ukf": "kf",
    "student-t-kf": "kf",
    "correntropy-kf": "kf",
    "parametric-ukf": "parametric-ekf",
    "lifted-kf-swinging": "lifted-kf",
    "latency-bank-kf": "kf",
    "latency-bank-lifted-kf": "lifted-kf",
}
"""Agents that also use the values of another agent; the steps of that search count for both."""

UNTUNED = frozenset({"random", "oracle", "informed", "ukf-as-printed"})
"""Agents without tunable values. `informed` has settings for each law of a target, found by hand. `ukf-as-printed` has
the noise that the reproduction of Zhang 2011 assumes."""
