"""Settings as canonical JSON, and their digest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def canonical_json(value: Mapping[str, Any]) -> str:
    """Return JSON with sorted keys and no blanks: the same text for equal content."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def settings_digest(settings: Mapping[str, Any]) -> str:
    """Return the SHA-256 of settings in canonical JSON."""
    return hashlib.sha256(canonical_json(settings).encode()).hexdigest()
