"""The extension: what users see of it. The modules beside it are the only users of the rest."""

from typing import Any, Dict, List, Tuple

import numpy as np

__version__: str

class Run:
    """A run; semfield.Run derives from it."""

    def __init__(self, how: str, config: Any, set: Dict[str, Any], run_dir: str, keep: List[str], scene: Any) -> None: ...
    @property
    def step(self) -> int: ...
    @property
    def train_s(self) -> float: ...
    @property
    def run_dir(self) -> str: ...
    @property
    def notes(self) -> List[str]: ...
    @property
    def history(self) -> List[Dict[str, Any]]: ...
    @property
    def config(self) -> Dict[str, Any]: ...
    def parameters(self) -> Dict[str, np.ndarray[Any, Any]]: ...

    _closed: bool
    _trains: bool
    _steps_left: int
    _close: Any
    _train: Any
    _train_more: Any
    _save: Any
    _set_labels: Any
    _apply: Any
    _annotations: Any
    _render: Any
    _channel_axes: Any
    _evaluate: Any
    _query: Any
    _frame_rows: Any
    _class_rows: Any
    _pixels: Any
    _facts: Any

def __getattr__(name: str) -> Any: ...
