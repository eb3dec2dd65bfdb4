"""vLLM in this process: the engine for large models on GPUs.

vLLM is a separate extra, since it pins its dependencies. Install it in a separate environment (``pip install '.[vllm]'``), or
run it as a server behind the ``openai`` engine.
"""

import asyncio
import threading
import uuid
from collections.abc import Coroutine, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling, is_too_long, reads_no_pictures
from models.semantic_reasoner.text.tokenizer import chat_text
from stable_data.errors import ConfigError

T = TypeVar("T")


class VllmEngine:
    """A language model in vLLM, bound to the grammar of the replies by its llguidance backend.

    Several threads may call :meth:`complete`: vLLM decodes all their requests in one running batch. The same request and seed
    give the same reply in the same batch only: to reproduce a run, use a response cache.

    Args:
        folder: A Hugging Face folder, or a model id of vLLM.
        sampling: How tokens are drawn.
        num_gpus: Number of GPUs that share the model's weights.
        options: Further arguments of ``vllm.AsyncEngineArgs``, such as ``max_model_len``.

    Raises:
        ConfigError: vLLM is not installed, or cannot load the model.
    """

    repeats = False

    def __init__(self, folder: str, sampling: Sampling | None = None, num_gpus: int = 1, **options: Any) -> None:
        try:
            import vllm
            from vllm.sampling_params import RequestOutputKind, StructuredOutputsParams
            from vllm.v1.engine.async_llm import AsyncLLM
        except ImportError as error:
            raise ConfigError(
                f"the vllm engine needs vLLM, which is not installed here ({error}): pip install '.[vllm]' in a separate "
                "environment, or serve the model elsewhere and use the openai engine",
                "extra_missing",
            ) from error
        self.name, self.sampling = f"vllm:{Path(folder).name}", sampling or Sampling()
        self._parameters, self._structured = vllm.SamplingParams, StructuredOutputsParams
        self._final = RequestOutputKind.FINAL_ONLY
        arguments = {
            "model": folder,
            "tensor_parallel_size": num_gpus,
            "structured_outputs_config": {"backend": "guidance"},
            "enable_prefix_caching": True,  # the prompts of a scene's three stages begin with the same text
            **options,
        }

        async def load() -> Any:  # in the loop of its requests, which then reads the replies
            return AsyncLLM.from_engine_args(vllm.AsyncEngineArgs(**arguments))

        self._loop = asyncio.new_event_loop()  # on its own thread, since the caller may run a loop itself
        self._thread = threading.Thread(target=self._loop.run_forever, name=self.name, daemon=True)
        self._thread.start()
        try:
            self._model = self._submitted(load()).result()
        except (OSError, ValueError, RuntimeError) as error:
            self._end_loop()
            found = str(error).strip().partition("\n")[0]
            raise ConfigError(f"vllm cannot load {folder} ({found}); is it a model's folder?", "model_invalid") from error

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Returns one completion for each request, in their order."""
        futures = [self._submitted(self._answer(request)) for request in requests]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()  # after an error or Ctrl-C; vLLM then gives up the request

    def close(self) -> None:
        """Ends vLLM and its processes, and frees its GPU memory; further requests fail."""
        self._model.shutdown()
        self._end_loop()

    async def _answer(self, request: Request) -> Completion:
        if request.pictures:
            return reads_no_pictures(self.name)
        tokenizer, longest = self._model.get_tokenizer(), self._model.model_config.max_model_len
        if asyncio.iscoroutine(tokenizer):  # in some versions
            tokenizer = await tokenizer
        chat = chat_text(tokenizer, request.messages, thinks=not request.form.binds)
        prompt = tokenizer(chat, add_special_tokens=False)["input_ids"]
        if len(prompt) >= longest:
            return is_too_long(len(prompt), longest)
        outputs = self._model.generate({"prompt_token_ids": prompt}, self._parameters_of(request), uuid.uuid4().hex)
        try:
            return _completion([output async for output in outputs][-1])
        except Exception as error:
            if self._model.errored:  # it would not answer another request either
                raise
            found = str(error.__cause__ or error).strip().partition("\n")[0]
            return Completion(
                "", len(prompt), failure=f"{self.name}: vLLM refused the request ({found})", code="request_refused"
            )

    def _parameters_of(self, request: Request) -> Any:
        s = self.sampling
        return self._parameters(
            temperature=s.temperature,
            top_p=s.top_p,
            top_k=s.top_k or -1,
            max_tokens=s.max_tokens,
            seed=request.seed % 2**31,
            structured_outputs=self._structured(grammar=request.form.grammar()) if request.form.binds else None,
            output_kind=self._final,
        )

    def _submitted(self, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop)

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _completion(output: Any) -> Completion:
    reply = output.outputs[0]
    read, written = len(output.prompt_token_ids or ()), len(reply.token_ids)
    if reply.finish_reason != "stop":
        return Completion(
            "", read, written, f"the reply ended with {reply.finish_reason!r} after {written:,} tokens", "reply_cut"
        )
    return Completion(reply.text, read, written)
