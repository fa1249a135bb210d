"""Types of the values that calls of this package return, for annotations."""

from kmp.predictor import Uncertainty
from kmp.primitive import Alternatives
from kmp.query import MotionPrediction
from kmp.storage import Stored

__all__ = ["Alternatives", "MotionPrediction", "Stored", "Uncertainty"]
