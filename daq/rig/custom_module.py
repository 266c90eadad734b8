"""A law of the user's own from a Python file: module = "FILE.py:NAME", where NAME is an `estimator.Effect`."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from pathlib import Path

from estimator.model import Effect


def load_effect(module: str, base: Path) -> Effect:
    """The object. Runs the user's file. Raises ValueError: what is wrong and what to do."""
    file, _, name = module.rpartition(":")
    path = (base / file).resolve()
    if not path.is_file():
        raise ValueError(f"there is no file {path}; the path starts at the rig file")
    key = f"rotorscope_custom_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(key, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[key] = loaded  # numba and dataclasses look their module up by name
    try:
        spec.loader.exec_module(loaded)
    except (Exception, SystemExit) as error:
        del sys.modules[key]
        raise ValueError(f"{path} fails with {type(error).__name__}: {error}; correct it") from error
    effect = getattr(loaded, name, None)
    if effect is None:
        held = [k for k, v in vars(loaded).items() if isinstance(v, Effect)]
        raise ValueError(f"{path} has no {name}; its effects are {', '.join(held) or 'none'}")
    if not isinstance(effect, Effect):
        raise ValueError(f"{name} of {path} is a {type(effect).__name__}, not an estimator.model.effect.Effect")
    return effect
