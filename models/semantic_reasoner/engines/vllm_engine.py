"""vLLM in this process: the engine for large models on GPUs.

vLLM is a separate extra, since it pins its dependencies. Install it in a separate environment (``pip install '.[vllm]'``), or
run it as a server behind the ``openai`` engine.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling, is_too_long
from models.semantic_reasoner.text.tokenizer import chat_text
from stable_data.errors import ConfigError


class VllmEngine:
    """A language model in vLLM: batched, and bound to the grammar of the replies by its llguidance backend.

    The same request and seed give the same reply in the same batch only: to reproduce a run, use a response cache.

    Args:
        folder: A Hugging Face folder, or a model id of vLLM.
        sampling: How tokens are drawn.
        num_gpus: Number of GPUs that share the model's weights.
        options: Further arguments of ``vllm.LLM``, such as ``max_model_len``.

    Raises:
        ConfigError: vLLM is not installed, or cannot load the model.
    """

    repeats = False

    def __init__(self, folder: str, sampling: Sampling | None = None, num_gpus: int = 1, **options: Any) -> None:
        try:
            import vllm
            from vllm.sampling_params import StructuredOutputsParams
        except ImportError as error:
            raise ConfigError(
                f"the vllm engine needs vLLM, which is not installed here ({error}): pip install '.[vllm]' in a separate "
                "environment, or serve the model elsewhere and use the openai engine",
                "extra_missing",
            ) from error
        self.name, self.sampling = f"vllm:{Path(folder).name}", sampling or Sampling()
        self._parameters, self._structured = vllm.SamplingParams, StructuredOutputsParams
        try:
            self._model = vllm.LLM(
                model=folder,
                tensor_parallel_size=num_gpus,
                structured_outputs_config={"backend": "guidance"},
                enable_prefix_caching=True,  # the prompts of a scene's three stages begin with the same text
                **options,
            )
        except (OSError, ValueError, RuntimeError) as error:
            found = str(error).strip().partition("\n")[0]
            raise ConfigError(f"vllm cannot load {folder} ({found}); is it a model's folder?", "model_invalid") from error

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Returns one completion for each request, in their order."""
        if not requests:
            return []
        tokenizer, longest = self._model.get_tokenizer(), self._model.llm_engine.model_config.max_model_len
        texts = [chat_text(tokenizer, r.messages, thinks=not r.form.binds) for r in requests]
        prompts = [tokenizer(text, add_special_tokens=False)["input_ids"] for text in texts]
        fits = [k for k, prompt in enumerate(prompts) if len(prompt) < longest]  # vLLM refuses the batch for one too long
        outputs = self._model.generate(
            [{"prompt_token_ids": prompts[k]} for k in fits], [self._parameters_of(requests[k]) for k in fits], use_tqdm=False
        )
        found = dict(zip(fits, map(_completion, outputs), strict=True))
        return [found.get(k) or is_too_long(len(prompt), longest) for k, prompt in enumerate(prompts)]

    def _parameters_of(self, request: Request) -> Any:
        s = self.sampling
        return self._parameters(
            temperature=s.temperature,
            top_p=s.top_p,
            top_k=s.top_k or -1,
            max_tokens=s.max_tokens,
            seed=request.seed % 2**31,
            structured_outputs=self._structured(grammar=request.form.grammar()) if request.form.binds else None,
        )


def _completion(output: Any) -> Completion:
    reply = output.outputs[0]
    read, written = len(output.prompt_token_ids or ()), len(reply.token_ids)
    if reply.finish_reason != "stop":
        return Completion(
            "", read, written, f"the reply ended with {reply.finish_reason!r} after {written:,} tokens", "reply_cut"
        )
    return Completion(reply.text, read, written)
