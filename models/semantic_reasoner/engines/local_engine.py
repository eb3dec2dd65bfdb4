"""Engines in this process: the embedded small Qwen3, or any causal language model in a Hugging Face folder, with a grammar."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import llguidance.hf
import llguidance.numpy
import numpy as np
import torch
from llguidance import LLExecutor, LLMatcher
from torch import Tensor
from transformers import AutoModelForCausalLM, AutoTokenizer, PreTrainedModel, PreTrainedTokenizerFast

from models.semantic_reasoner.engines.batched_decoding import ATTENTION, Decoder
from models.semantic_reasoner.engines.incremental_batches import Conversation
from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling, is_too_long, reads_no_pictures
from models.semantic_reasoner.engines.shared_batch import SharedBatch
from models.semantic_reasoner.engines.token_sampling import TokenSampler
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.reply_json import POSITION, parse_beginning, parse_reply
from models.semantic_reasoner.text.tokenizer import chat_text
from stable_data.errors import ConfigError

_DEFAULT = Sampling()
_CLOSING = "]}"
"""The end of a reply."""


@dataclass(slots=True, eq=False)
class _Sequence:
    """A request that is being decoded.

    Attributes:
        index: Number of the request.
        prompt: Tokens of the question.
        request: The request.
        matcher: Binds the reply to its form; None: it is free.
        draws: The random stream.
        reply: Tokens of the reply so far.
        num_judged: Number of objects of the reply that were judged as soon as they were written.
        redraws: How often the place of the next of them was drawn again.
    """

    index: int
    prompt: list[int]
    request: Request
    matcher: LLMatcher | None
    draws: np.random.Generator
    reply: list[int] = field(default_factory=list)
    num_judged: int = 0
    redraws: int = 0


class LocalEngine:
    """A language model in this process: batched, seeded, and bound to the form of the replies.

    Sequences are decoded ``num_slots`` at a time, and the next one takes the slot of a finished one. Each has its own random
    stream from its seed, and logits that do not depend on the rest of its batch, see
    :mod:`models.semantic_reasoner.engines.batched_decoding`. So a reply depends on its request alone, whatever else is decoded.

    Several threads may call :meth:`complete`: their requests share one running batch.

    A reply that would end without the objects that its form requires continues with one of them.

    Args:
        model: A causal language model.
        tokenizer: Its tokenizer, with a chat template.
        name: Name of the engine.
        sampling: How tokens are drawn.
        num_slots: Largest number of sequences at a time.
        is_constrained: Whether replies are bound to their form.

    Attributes:
        num_steps: Number of decoding steps so far.
        num_tokens: Number of tokens that these steps have drawn, one for each sequence in the batch.
    """

    repeats = True

    def __init__(
        self,
        model: PreTrainedModel,
        tokenizer: PreTrainedTokenizerFast,
        name: str,
        sampling: Sampling = _DEFAULT,
        num_slots: int = 64,
        is_constrained: bool = True,
    ) -> None:
        model.set_attn_implementation(ATTENTION)
        self.name, self.sampling = name, sampling
        self._model, self._tokenizer = model.eval(), tokenizer
        self._num_slots, self._is_constrained = num_slots, is_constrained
        self._vocabulary = model.get_output_embeddings().weight.shape[0]
        self._end = {model.config.eos_token_id, tokenizer.eos_token_id} - {None}
        closing = np.zeros(self._vocabulary, bool)
        words = tokenizer.convert_ids_to_tokens(range(len(tokenizer)))
        closing[[k for k, word in enumerate(words) if word.endswith(_CLOSING)]] = True
        self._completing = {k for k, word in enumerate(words) if "}" in word}
        self._sampler = TokenSampler(sampling, closing)
        self._shared = SharedBatch(lambda: _DecodingBatch(self))
        self.num_steps = self.num_tokens = 0
        self._guide = llguidance.hf.from_tokenizer(tokenizer, n_vocab=self._vocabulary)
        self._executor = LLExecutor()

    @classmethod
    def load(
        cls, folder: Path, name: str = "", sampling: Sampling = _DEFAULT, num_slots: int = 64, is_constrained: bool = True
    ) -> "LocalEngine":
        """Loads an engine from a Hugging Face folder with config.json, weights in safetensors and a tokenizer.

        The name is by default that of the folder; see the class for the other arguments.

        Raises:
            ConfigError: The folder has no causal language model, or its tokenizer has no chat template (``model_invalid``).
        """
        try:
            tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
            loaded: Any = AutoModelForCausalLM.from_pretrained(
                folder,
                local_files_only=True,
                trust_remote_code=False,
                use_safetensors=True,
                dtype="auto",
                output_loading_info=True,
            )
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            found = str(error).strip().partition("\n")[0]
            raise ConfigError(
                f"{folder}: no causal language model ({found}); expected a Hugging Face folder with config.json, "
                "model.safetensors and a tokenizer",
                "model_invalid",
            ) from error
        if not isinstance(tokenizer, PreTrainedTokenizerFast) or not tokenizer.chat_template:
            raise ConfigError(
                f"{folder}: its tokenizer is not a fast one or has no chat template, expected that of an instruction-tuned model",
                "model_invalid",
            )
        model, report = loaded
        # transformers fills missing tensors with random values, and reports them in its log only.
        if lacking := sorted({*report["missing_keys"], *(str(k) for k in report["mismatched_keys"])}):
            raise ConfigError(
                f"{folder}: {lacking[0]} and {len(lacking) - 1} more tensors are missing or of another shape, expected the whole "
                "model",
                "model_invalid",
            )
        if torch.cuda.is_available():
            model.to(device="cuda")
        else:
            has = torch.cpu.get_capabilities()
            is_fast = has.get("avx512_bf16") or has.get("amx_bf16")  # elsewhere half precision is slower than single
            model.to(dtype=torch.bfloat16 if is_fast else torch.float32)
        return cls(model, tokenizer, name or f"transformers:{folder.name}", sampling, num_slots, is_constrained)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Returns one completion for each request, in their order; they join the requests of other threads."""
        futures = [self._shared.submit(request) for request in requests]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()  # after an error or Ctrl-C; a finished one cannot be cancelled

    def converse(self, requests: Sequence[Request]) -> Conversation[Completion, Request]:
        """Yields completions when they are done; the requests that follow take their slots, so the batch stays full.

        The batch is not shared with other threads, so that the order of completions depends on the requests alone.
        """
        batch, count = _DecodingBatch(self), 0
        while requests or batch.is_busy:
            for request in requests:
                batch.add(count, request)
                count += 1
            done = batch.advance()
            requests = (yield done) if done else ()

    def _start(self, index: int, request: Request) -> _Sequence | Completion:
        if request.pictures:
            return reads_no_pictures(self.name)
        chat = chat_text(self._tokenizer, request.messages, thinks=not request.form.binds)
        prompt: list[int] = self._tokenizer(chat, add_special_tokens=False)["input_ids"]
        longest = self._model.config.get_text_config().max_position_embeddings
        if len(prompt) + 16 > longest:  # fewer tokens hold no reply
            return is_too_long(len(prompt), longest)
        matcher = None
        if self._is_constrained and request.form.binds:
            matcher = self._matcher(request.form.grammar())
            if matcher.is_error():
                return Completion("", len(prompt), failure=f"grammar: {matcher.get_error()}", code="grammar_invalid")
        return _Sequence(index, prompt, request, matcher, np.random.default_rng(request.seed))

    def _matcher(self, grammar: str) -> LLMatcher:
        return LLMatcher(self._guide, LLMatcher.grammar_from_lark(grammar))

    def _reopen(self, sequence: _Sequence, room: int) -> bool:
        """Removes the end of a reply that lacks required objects, so that one of these follows.

        Returns False if none is missing, or if there is no room for it in the ``room`` tokens of a reply.
        """
        form = sequence.request.form
        if sequence.matcher is None or not isinstance(form, ReplyGrammar) or not form.asks:
            return False
        whole = self._text(sequence.reply)
        lacking = form.lacking(whole)
        if lacking is None:
            return False
        objects = whole.removesuffix(_CLOSING)
        count = len(parse_reply(whole).objects)
        if count and count * room < (count + 1) * len(sequence.reply):
            return False  # an object of the mean length would be cut off
        # The last removed token may hold a part of an object, which the new grammar starts with.
        self._shorten(sequence.reply, len(objects))
        start = objects[len(self._text(sequence.reply)) :] + ("," if count else "")
        is_long = 2 * len(sequence.reply) > room  # then only missing objects may follow
        at_most = 1 if is_long else form.at_most - count
        sequence.matcher = self._matcher(form.grammar_after(start, lacking, at_most))
        return True

    def _redraw(self, sequence: _Sequence) -> bool:
        """Removes the place of the last object and what follows it, if the object is just complete and is refused."""
        refuses = sequence.request.refuses
        if refuses is None or sequence.matcher is None or not sequence.reply or sequence.reply[-1] not in self._completing:
            return False
        text = self._text(sequence.reply)
        objects = parse_beginning(text)
        if len(objects) <= sequence.num_judged:
            return False
        if sequence.redraws >= self.sampling.redraws or not refuses(objects):
            sequence.num_judged, sequence.redraws = len(objects), 0
            return False
        sequence.redraws += 1
        sequence.matcher.rollback(self._shorten(sequence.reply, text.rindex(POSITION) + len(POSITION)))
        return True

    def _shorten(self, reply: list[int], length: int) -> int:
        """Removes the last tokens until the text has at most ``length`` characters, and returns their number."""
        before = len(reply)
        while len(self._text(reply)) > length:
            reply.pop()
        return before - len(reply)

    def _draw(self, logits: Tensor, active: list[_Sequence]) -> list[int]:
        """Draws a token for each sequence."""
        allowed, may_end = None, np.zeros(len(active), bool)
        matchers = [(s.matcher, row) for row, s in enumerate(active) if s.matcher is not None]
        if matchers:
            allowed = llguidance.numpy.allocate_token_bitmask(len(active), self._vocabulary)
            llguidance.numpy.fill_next_token_bitmask_par(self._executor, matchers, allowed)
            may_end[[row for _, row in matchers]] = self._sampler.may_end(allowed[[row for _, row in matchers]])
        end_draws = np.array([s.draws.random() if ends else np.nan for s, ends in zip(active, may_end, strict=True)])
        draws = np.array([s.draws.random() for s in active])
        # The last redraw is accepted as it is, so it is drawn as usual.
        redraws = np.array([s.redraws if s.redraws < self.sampling.redraws else 0 for s in active])
        return self._sampler.draw(logits, allowed, draws, end_draws, redraws)

    def _text(self, tokens: list[int]) -> str:
        return str(self._tokenizer.decode(tokens, skip_special_tokens=True, clean_up_tokenization_spaces=False))

    def _completion(self, sequence: _Sequence, ended: bool) -> Completion:
        text = self._text(sequence.reply)
        read, written = len(sequence.prompt), len(sequence.reply)
        if not ended:
            return Completion("", read, written, f"the reply was cut off after {written:,} tokens", "reply_cut")
        return Completion(text, read, written)


class _DecodingBatch:
    """The sequences that an engine decodes at a time, and those that wait for a slot."""

    def __init__(self, engine: LocalEngine) -> None:
        self._engine = engine
        self._decoder = Decoder(engine._model, engine._num_slots, engine._tokenizer.pad_token_id or 0)
        self._waiting: deque[_Sequence] = deque()
        self._active: list[_Sequence] = []
        self._refused: list[tuple[int, Completion]] = []

    @property
    def is_busy(self) -> bool:
        """Whether requests are open."""
        return bool(self._waiting or self._active or self._refused)

    def add(self, number: int, request: Request) -> None:
        """Adds a request, which begins when there is a slot."""
        sequence = self._engine._start(number, request)
        if isinstance(sequence, Completion):
            self._refused.append((number, sequence))
        else:
            self._waiting.append(sequence)

    def advance(self) -> list[tuple[int, Completion]]:
        """Decodes one token of each sequence, and returns the completions that end with it."""
        done, self._refused = self._refused, []
        engine, decoder, active = self._engine, self._decoder, self._active
        while self._waiting and len(active) < decoder.num_slots:
            active.append(self._waiting.popleft())
            decoder.admit(active[-1].prompt)
        if active:
            engine.num_steps, engine.num_tokens = engine.num_steps + 1, engine.num_tokens + len(active)
            tokens = engine._draw(decoder.logits, active)
            done += self._append(tokens)
            if active:
                decoder.step(tokens)
        return done

    def _append(self, tokens: list[int]) -> list[tuple[int, Completion]]:
        """Appends a token to each sequence, and removes the completed ones from the batch and ``tokens``."""
        engine, decoder, active, done = self._engine, self._decoder, self._active, []
        longest = engine._model.config.get_text_config().max_position_embeddings
        for slot in reversed(range(len(active))):  # from the last, since a release moves the last sequence
            sequence, token = active[slot], tokens[slot]
            ended = token in engine._end
            if not ended:
                sequence.reply.append(token)
                if sequence.matcher is not None:
                    sequence.matcher.consume_token(token)
                    ended = sequence.matcher.is_stopped()
            room = min(engine.sampling.max_tokens, longest - len(sequence.prompt))
            if engine._redraw(sequence) or (ended and engine._reopen(sequence, room)):
                ended = False
                # The last remaining token is decoded again, for the logits after it.
                so_far = sequence.prompt + sequence.reply
                decoder.rewind(slot, len(so_far) - 1)
                tokens[slot] = so_far[-1]
            if ended or len(sequence.reply) >= room:
                done.append((sequence.index, engine._completion(sequence, ended)))
                last = decoder.release(slot)
                if last is not None:
                    active[slot], tokens[slot] = active[last], tokens[last]
                active.pop()
                tokens.pop()
        return done
