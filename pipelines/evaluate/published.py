"""What the paper prints, for the columns of published numbers. Nothing here was measured by this project.

Source: STABLE, arXiv 2605.16137, Tables 1 to 4. Its OC has no unit in Table 1; the text defines a share of pairs, so that 15.6 is taken as
15.6 %. Its systems ran on MesaTask-10K, with its assets and renderer, and with Qwen3-8B.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

SOURCE = "STABLE, arXiv 2605.16137"


@dataclass(frozen=True, slots=True)
class PublishedRow:
    """A row of the paper's Table 1.

    Attributes:
        name: The paper's name of the system.
        fid: Fréchet Inception distance.
        criteria: The five criteria of the GPT-score: CwT, OSR, PPI, LCR and OV, 1 to 10.
        average: The average that is printed.
        oc: Object collision, %.
        awt: Align with Task, %.
        aws: Align with Scene Graph, %.
    """

    name: str
    fid: float
    criteria: tuple[float, float, float, float, float]
    average: float
    oc: float
    awt: float
    aws: float


TABLE_1: Mapping[str, PublishedRow] = MappingProxyType(
    {
        "zero_shot": PublishedRow("GPT-4o", 85.5, (6.0, 8.0, 8.4, 6.2, 6.9), 7.1, 25.4, 25.2, 18.5),
        "holodeck": PublishedRow("Holodeck-Table", 90.2, (4.2, 7.0, 7.8, 5.0, 8.5), 6.5, 0.0, 18.4, 11.2),
        "idesign": PublishedRow("I-Design-Table", 94.8, (5.0, 8.0, 8.4, 5.4, 7.7), 6.9, 10.3, 16.2, 9.6),
        "mesatask": PublishedRow("MesaTask", 40.6, (7.8, 9.2, 9.4, 8.6, 9.0), 8.8, 15.6, 90.2, 81.5),
        "files": PublishedRow("TabletopGen", 54.8, (8.6, 9.3, 9.5, 8.9, 8.7), 9.0, 23.5, 91.7, 83.6),
        "steerable": PublishedRow("Steerable", 43.7, (7.5, 9.2, 9.7, 8.7, 8.8), 8.8, 0.0, 99.4, 91.1),
        "stable": PublishedRow("Ours", 38.6, (9.0, 9.4, 9.6, 9.1, 8.9), 9.2, 0.0, 99.4, 99.0),
    }
)
"""Table 1, by the names that the systems have here, in the paper's order."""

TABLE_2: Mapping[str, tuple[bool, bool, bool, bool]] = MappingProxyType(
    {
        "MesaTask's optimiser": (True, True, False, False),
        "Steerable": (True, True, False, False),
        "Physics Corrector": (True, True, True, True),
    }
)
"""Table 2: whether layouts with 0-10, 10-20, 20-30 and 30-40 collisions come out without any."""

TABLE_3A: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"without L_sup": (4.7, 9.8), "without L_obj-table": (13.6, 5.4), "without L_obj-obj": (11.9, 15.8), "full": (0.0, 0.0)}
)
"""Table 3 (a): OC and floating objects, %, without one of the losses."""

TABLE_3B: Mapping[str, tuple[float, float]] = MappingProxyType({"one_shot": (89.9, 78.6), "stable": (99.4, 86.1)})
"""Table 3 (b): AwT and distractor rate, %, of one request and of three stages."""

REARRANGEMENT: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {"LEGO-Net": (0.28, 0.43, 0.32), "StructDiffusion": (0.21, 0.23, 0.25), "Ours": (0.14, 0.08, 0.0)}
)
"""Rearrangement: distance moved, EMD to the ground truth, and OC, as printed; without units in the paper."""

MANIPULABILITY: Mapping[str, tuple[float, float]] = MappingProxyType({"kettle": (0.87, 0.65), "fork": (0.91, 0.71)})
"""ManipVQA on scenes of the paper: AP at an overlap of 0.5 and 0.75."""
