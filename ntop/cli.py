"""`ntop <verb> ...`: every stage and tool, its flags derived from its `main` signature.

A stage's `config` flag takes the JSON that the workflow logs, so a logged command line is a
complete recipe. Its `version` must be the stage's own, or the run is refused. A parameter of one
letter is a flag of one letter, a bool is a flag without value, and `*words` is what follows `--`.
"""

import argparse
import importlib
import inspect
import json
import os
import select
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from ntop.config.base import explain
from ntop.conventions import ConfigError, NtopError
from ntop.stages import STAGES, VERSIONS

TOOLS = ("check", "fetch", "lease", "lens", "orphans", "plan", "status", "stripes")
EXIT_USER_ERROR = 2
EXIT_UNREAD = 141  # 128 + SIGPIPE: what a shell reports of `seq 100000` in `seq 100000 | head -1`


def main(arguments: list[str] | None = None) -> int:
    """Run one verb; an error meant for people ends with its text and exit code 2.

    Otherwise the exit code is what the verb's `main` returns, 0 for None. Where nobody reads what
    is printed any more (`| head -1`) it is 141, without a word.
    """
    try:
        try:
            return run_verb(sys.argv[1:] if arguments is None else arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        if not _output_is_unread():
            raise
        # what is still buffered would be written, and fail, once more when Python ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_UNREAD


def _output_is_unread() -> bool:
    """Whether standard output is a pipe whose reader has gone."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), select.POLLOUT)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def run_verb(words: list[str]) -> int:
    """The exit code of the verb that the first word names."""
    verbs = {name: f"ntop.stages.s{number}_{name}" for number, name, _ in STAGES}
    verbs |= {name: f"ntop.tools.{name}" for name in TOOLS}
    if not words or words[0] in {"-h", "--help"}:
        sys.stdout.write(f"usage: ntop <verb> --help\nverbs: {', '.join(verbs)}\n")
        return 0
    verb, *rest = words
    if verb not in verbs:
        sys.stderr.write(f"ntop: unknown verb {verb!r}; have {', '.join(verbs)}\n")
        return EXIT_USER_ERROR
    entry = importlib.import_module(verbs[verb]).main
    try:
        values = parse(entry, verb=verb, words=rest)
        following = values.pop(_following(entry), [])
        return entry(*following, **values) or 0
    except NtopError as error:
        sys.stderr.write(f"ntop {verb}: {error}\n")
        return EXIT_USER_ERROR


def parse(entry: Callable[..., int | None], *, verb: str, words: list[str]) -> dict[str, Any]:
    """Values for the parameters of `entry`, read from command line words."""
    parser = argparse.ArgumentParser(
        prog=f"ntop {verb}",
        description=inspect.getdoc(entry),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    following = _following(entry)
    rest: list[str] = []
    if following:
        # cut here: what argparse makes of `--` differs between Python versions
        cut = words.index("--") if "--" in words else len(words)
        words, rest = words[:cut], words[cut + 1 :]
        parser.usage = f"ntop {verb} [flags] -- {following} ..."
    for name, parameter in inspect.signature(entry).parameters.items():
        if name == following:
            continue
        kind, many = _kind(parameter.annotation)
        flag = f"-{name}" if len(name) == 1 else f"--{name.replace('_', '-')}"
        if kind is bool:
            parser.add_argument(flag, action="store_true")
            continue
        required = parameter.default is inspect.Parameter.empty
        parser.add_argument(
            flag,
            type=_reader(kind, verb=verb),
            nargs="*" if many else None,
            required=required,
            default=None if required else parameter.default,
            metavar=kind.__name__,
        )
    values = vars(parser.parse_args(words))
    if following:
        if not rest:
            parser.error(f"expected `-- {following} ...` after the flags, got nothing to run")
        values[following] = rest
    return values


def _following(entry: Callable[..., int | None]) -> str:
    """The parameter that takes what follows `--`; empty if there is none."""
    parameters = inspect.signature(entry).parameters.values()
    return next((p.name for p in parameters if p.kind is inspect.Parameter.VAR_POSITIONAL), "")


def _kind(annotation: Any) -> tuple[type, bool]:
    """The type to read and whether several values are taken (`list[T]`)."""
    if get_origin(annotation) in {Union, types.UnionType}:
        annotation = next(a for a in get_args(annotation) if a is not type(None))
    if get_origin(annotation) is list:
        return get_args(annotation)[0], True
    return annotation, False


def _reader(kind: type, *, verb: str) -> Callable[[str], Any]:
    if not issubclass(kind, BaseModel):
        return kind

    def read(text: str) -> BaseModel:
        return read_section(text, kind=kind, verb=verb)

    return read


def read_section(text: str, *, kind: type[BaseModel], verb: str) -> BaseModel:
    """A stage's section from JSON text or from the path of a JSON file.

    Raises:
        ConfigError: not JSON, a wrong version, or values the section refuses.
    """
    try:
        source = text if text.lstrip().startswith("{") else Path(text).read_text()
    except OSError as error:
        raise ConfigError(f"cannot read --config {text}: {error.strerror}") from error
    try:
        values = json.loads(source)
    except json.JSONDecodeError as error:
        raise ConfigError(f"--config is not JSON: {error}") from error
    version = VERSIONS[verb]
    given = values.pop("version", version)
    if given != version:
        raise ConfigError(
            f"the configuration is for version {given} of stage {verb}, this is version "
            f"{version}: rerun the workflow with this version of ntop"
        )
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise ConfigError(explain(error, f"section {verb}")) from error


if __name__ == "__main__":
    sys.exit(main())
