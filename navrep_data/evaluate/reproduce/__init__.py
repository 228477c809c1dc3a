"""The paper's figures and table again, from results files: what was measured here beside what the authors showed."""

from navrep_data.evaluate.reproduce.driver import FIGURES, Reproduced, reproduce

__all__ = ["FIGURES", "Reproduced", "reproduce"]
