"""The speed of the reasoner's local engine: batched against one request at a time, with a grammar against without.

``python -m benchmarks.reasoner_speed RUN [--model DIR] [--scenes N] [--json FILE]``. RUN is the folder of a preprocess run: the
instructions and tables of its test scenes are laid out in three stages. The model's folder is the embedded one by default.

- scenes: staged layouts a minute at several batch sizes, without checks and retries;
- generate: the same questions to the same model by the transformers function ``generate``, one after the other, without a
  grammar, against the engine with all of them at once; requests a second, and tokens a second, since replies differ in length;
- workers: eight workers that ask one engine, each twice for four replies; tokens a second if their requests join one
  running batch, divided by those if the engine answers the batch of one worker at a time;
- grammar: seconds a token with the grammar of replies, divided by those without, reading of the questions excluded.

Run with ``OMP_NUM_THREADS`` equal to the number of cores.
"""

import json
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import torch
import typer
from transformers import AutoModelForCausalLM, AutoTokenizer

from benchmarks.reasoner import held_out
from models.semantic_reasoner.engines.incremental_batches import collect_answers
from models.semantic_reasoner.engines.local_engine import LocalEngine
from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling
from models.semantic_reasoner.engines.registry import EMBEDDED
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.staged_layout import staged_layouts, task_of_scene
from models.semantic_reasoner.text.prompt import ReasonerQuestion, messages
from models.semantic_reasoner.text.reply_json import layout_objects
from models.semantic_reasoner.text.tokenizer import chat_text
from stable_data.scene import Scene, Stage

SAMPLING = Sampling(max_tokens=1024)
_WORKERS, _ASKS, _BATCH = 8, 2, 4


def scenes_a_minute(engine: LocalEngine, scenes: Sequence[Scene], at_once: int) -> float:
    """Measures staged layouts a minute."""
    reasoner = SemanticReasoner(engine, tries=1)
    began = time.perf_counter()
    for first in range(0, len(scenes), at_once):
        part = scenes[first : first + at_once]
        staged_layouts(reasoner, [task_of_scene(s) for s in part], range(len(part)))
    return 60 * len(scenes) / (time.perf_counter() - began)


def questions(scenes: Sequence[Scene]) -> list[Request]:
    """Returns for each scene the question of its last stage, with the data's own earlier stages: the longest questions."""
    found = []
    for seed, scene in enumerate(scenes):
        known = layout_objects([o for o in scene.objects if o.stage is not Stage.SECONDARY])
        ask = replace(ReasonerQuestion(task_of_scene(scene).instruction, scene.table, Stage.SECONDARY), layout=known)
        found.append(Request(tuple(messages(ask)), ReplyGrammar.of_table(scene.table), seed))
    return found


def by_generate(folder: Path, asked: Sequence[Request]) -> tuple[float, int]:
    """Measures seconds and tokens of transformers' ``generate``, one request after the other."""
    tokenizer = AutoTokenizer.from_pretrained(folder)
    model = AutoModelForCausalLM.from_pretrained(folder, dtype=torch.float32).eval()
    began, tokens = time.perf_counter(), 0
    for request in asked:
        torch.manual_seed(request.seed)
        ids = tokenizer(chat_text(tokenizer, request.messages), return_tensors="pt", add_special_tokens=False)
        completions = model.generate(
            **ids,
            do_sample=True,
            temperature=SAMPLING.temperature,
            top_p=SAMPLING.top_p,
            top_k=SAMPLING.top_k,
            max_new_tokens=SAMPLING.max_tokens,
        )
        tokens += completions.shape[1] - ids["input_ids"].shape[1]
    return time.perf_counter() - began, tokens


def shared_ratio(engine: LocalEngine, asked: Sequence[Request], rounds: int) -> tuple[float, float]:
    """Measures a batch that all workers share against batches of one worker each.

    Returns:
        The ratio of tokens a second, and the sequences of a step of the shared batch.
    """
    requests = [replace(asked[k % len(asked)], seed=k) for k in range(_WORKERS * _ASKS * _BATCH)]
    batches = [requests[first : first + _BATCH] for first in range(0, len(requests), _BATCH)]
    lock = threading.Lock()

    def in_turn(batch: list[Request]) -> list[Completion]:
        with lock:
            return collect_answers(engine.converse(batch), len(batch))

    def seconds(complete: Callable[[list[Request]], list[Completion]]) -> tuple[float, list[list[Completion]]]:
        began = time.perf_counter()
        with ThreadPoolExecutor(_WORKERS) as workers:
            found = list(workers.map(lambda w: [complete(batch) for batch in batches[w::_WORKERS]], range(_WORKERS)))
        return time.perf_counter() - began, [completions for some in found for completions in some]

    ratios, sequences = [], []
    for _ in range(rounds):
        apart, expected = seconds(in_turn)
        steps, tokens = engine.num_steps, engine.num_tokens
        together, found = seconds(engine.complete)
        assert found == expected  # so the tokens are the same too
        ratios.append(apart / together)
        sequences.append((engine.num_tokens - tokens) / (engine.num_steps - steps))
    return median(ratios), median(sequences)


def grammar_share(engine: LocalEngine, free: LocalEngine, asked: Sequence[Request], rounds: int) -> float:
    """Measures the additional cost of a token with the grammar, as a share of its cost without; without reading the questions.

    Replies differ in length, so both engines get enough requests to keep every slot busy. The time for one token after each
    question is subtracted.
    """
    many = [replace(r, seed=1000 * k + r.seed) for k in range(4) for r in asked]

    def seconds_a_token(of: LocalEngine) -> float:
        short = LocalEngine(of._model, of._tokenizer, "short", replace(SAMPLING, max_tokens=1), is_constrained=False)
        began = time.perf_counter()
        short.complete(many)
        read = time.perf_counter() - began
        began = time.perf_counter()
        completions = of.complete(many)
        return (time.perf_counter() - began - read) / sum(c.reply_tokens or 0 for c in completions)

    pairs = [(seconds_a_token(engine), seconds_a_token(free)) for _ in range(rounds)]
    return median(bound / loose for bound, loose in pairs) - 1


def main(
    run: Annotated[str, typer.Argument(help="Folder of a preprocess run.")],
    model: Annotated[Path, typer.Option(help="A model's folder.")] = EMBEDDED,
    scenes: Annotated[int, typer.Option(help="Number of scenes.")] = 64,
    rounds: Annotated[int, typer.Option(help="Rounds of the comparison with and without a grammar; the median counts.")] = 3,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints a line for each figure."""
    engine = LocalEngine.load(model, sampling=SAMPLING)
    free = LocalEngine.load(model, sampling=SAMPLING, is_constrained=False)
    truth = held_out(run, "test", scenes)
    asked = questions(truth)
    engine.complete(asked[:2])  # data that is computed once is not timed
    figures: dict[str, Any] = {"cores": len(os.sched_getaffinity(0)), "threads": torch.get_num_threads(), "scenes": len(truth)}
    for at_once in (1, 8, 64):
        part = truth[: max(1, min(len(truth), 4 * at_once))]
        figures[f"scenes_a_minute_{at_once}"] = round(scenes_a_minute(engine, part, at_once), 1)
    began = time.perf_counter()
    completions = engine.complete(asked)
    seconds = time.perf_counter() - began
    their_seconds, their_tokens = by_generate(model, asked)
    figures["tokens_a_second"] = round(sum(c.reply_tokens or 0 for c in completions) / seconds)
    figures["generate_tokens_a_second"] = round(their_tokens / their_seconds)
    figures["requests_ratio"] = round(their_seconds / seconds, 2)
    figures["tokens_ratio"] = round(figures["tokens_a_second"] / max(1, figures["generate_tokens_a_second"]), 2)
    ratio, sequences = shared_ratio(engine, asked, rounds)
    figures["shared_tokens_ratio"], figures["shared_sequences_a_step"] = round(ratio, 2), round(sequences, 1)
    figures["grammar_overhead_percent"] = round(100 * grammar_share(engine, free, asked, rounds), 1)
    for key, value in figures.items():
        print(f"{key:28}{value:>10}")
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
