"""A result of the ladder, as if it had been measured."""

from fruitlangs.benchmarks.ladder.ladder import StageResult
from fruitlangs.benchmarks.ladder.stages import TRUE_POSES
from fruitlangs.engine.evaluation.metrics import CountMetrics

METRICS = CountMetrics(
    radius=0.5, predicted=90, visible=100, total=120, matched=85, ignored=2, precision=0.9659, recall=0.85, f1=0.9043,
    doubles=1, merges=2, count_error=-10, relative_count_error=-0.1, relative_total_error=-0.25, center_error=0.08,
    diameter_error=0.06, diameter_bias=-0.01,
)  # fmt: skip
RESULT = StageResult(
    species="apple",
    seed=102,
    scene="apple-small-102",
    stage=TRUE_POSES,
    counted=90,
    near=METRICS,
    ece=0.02,
    interval=(88, 101),
    total_interval=(100, 130),
    total_estimate=112.5,
    psnr=23.4,
    ssim=0.7,
    views=60,
)
