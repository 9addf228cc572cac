"""Figures that the PPL paper reports (NeurIPS 2025), for showing beside our own figures.

From the paper's own simulators (MetaDrive, robosuite) and neural expert: to compare orders of
methods with, not numbers. Standard deviations are over five training seeds where given.
"""

from __future__ import annotations

from typing import NamedTuple


class Reported(NamedTuple):
    """A row of the paper; None where it gives no figure."""

    human_data: str | None
    total_data: str | None
    success: str
    episodic_return: str | None = None
    route_completion: str | None = None


# appendix, "MetaDrive, neural expert"; Table Wiping; Nut Assembly
METHODS: dict[str, dict[str, Reported]] = {
    "driving": {
        "ppl": Reported("1.2K", "6K", "0.80±0.04", "329.9±13.4", "0.92±0.03"),
        "bc": Reported("20K", None, "0.12±0.04", "142.7±27.5", "0.46±0.07"),
        "gail": Reported("20K", "1M", "0.34±0.08", "196.5±14.1", "0.60±0.09"),
        "hg_dagger": Reported("2.0K", "10K", "0.42", None, "0.72"),  # its row "BC loss only"
        "ensemble_dagger": Reported("3.2K", "10K", "0.41±0.08", "238.6±13.0", "0.69±0.07"),
        "thrifty_dagger": Reported("2.9K", "10K", "0.49±0.07", "248.2±27.8", "0.75±0.06"),
        "pvp": Reported("2.5K", "10K", "0.56±0.07", "258.1±23.4", "0.76±0.05"),
        "iwr": Reported("2.7K", "10K", "0.33±0.11", "217.0±20.9", "0.67±0.06"),
        "eil": Reported("3.9K", "10K", "0.11±0.06", "131.8±29.5", "0.42±0.11"),
        "haco": Reported("2.6K", "10K", "0.36±0.15", "210.2±25.2", "0.64±0.10"),
    },
    "table_wiping": {
        "ppl": Reported("0.2K", "2K", "0.80"),
        "bc": Reported("10K", None, "0.11"),
        "gail": Reported("10K", "1M", "0.37"),
        "pvp": Reported("2.3K", "4K", "0.58"),
        "iwr": Reported("2.5K", "4K", "0.51"),
        "eil": Reported("2.4K", "4K", "0.53"),
        "haco": Reported("2.9K", "4K", "0.48"),
    },
    "nut_assembly": {
        "ppl": Reported("48K", "200K", "0.51"),
        "bc": Reported("100K", None, "0.02"),
        "gail": Reported("100K", "1M", "0.08"),
        "pvp": Reported("49K", "200K", "0.35"),
        "iwr": Reported("54K", "200K", "0.29"),
        "eil": Reported("48K", "200K", "0.25"),
        "haco": Reported("77K", "200K", "0.15"),
    },
}

# "ablation, MetaDrive, neural expert, 10K total"; names as in
# `experiments.studies.ablation.ROWS`
ABLATION: dict[str, Reported] = {
    "imitation on a+": Reported("1.9K", "10K", "0.36", None, "0.65"),
    "random a+": Reported("2.2K", "10K", "0.45", None, "0.73"),
    "random a-": Reported("2.3K", "10K", "0.38", None, "0.69"),
    "DPO": Reported("1.6K", "10K", "0.80", None, "0.91"),
    "IPO": Reported("2.6K", "10K", "0.35", None, "0.61"),
    "SLiC-HF": Reported("3.0K", "10K", "0.32", None, "0.59"),
    "BC loss only": Reported("2.0K", "10K", "0.42", None, "0.72"),
    "CPO loss only": Reported("5.8K", "10K", "0.04", None, "0.31"),
    "rule-based f": Reported("1.9K", "10K", "0.78", None, "0.91"),
    "PPL": Reported("1.8K", "10K", "0.81", None, "0.92"),
}
