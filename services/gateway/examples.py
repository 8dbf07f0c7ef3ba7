"""What OpenAPI cannot see in the code: binary bodies, and examples that work as they are."""

from __future__ import annotations

from typing import Any

_INTRINSICS = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}

CREATE_SESSION: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {"type": "object", "required": ["calibration"]},
                "examples": {
                    "registered depth": {
                        "value": {
                            "name": "kitchen",
                            "mode": "live",
                            "calibration": {
                                "colour": {"intrinsics": _INTRINSICS},
                                "depth_scale": 1000.0,
                            },
                        }
                    },
                    "offline, first pose given": {
                        "value": {
                            "mode": "offline",
                            "seed": 0,
                            "calibration": {
                                "colour": {"intrinsics": _INTRINSICS, "distortion": []},
                                "depth_scale": 5000.0,
                                "max_depth_m": 10.0,
                            },
                            "T_map_first": {
                                "position": {"x": 0.0, "y": 0.0, "z": 1.2},
                                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                            },
                        }
                    },
                },
            }
        },
    }
}

POST_FRAME: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": (
            "A msgpack map: seq, t_ns, rgb {encoding: jpeg|png|rgb8, bytes}, depth {encoding: "
            "png16|raw16|zlib16, bytes, scale?}, prior? {T_odom_camera}, flags? [no_keyframe]. "
            "The WebSocket /v1/sessions/{name}/stream takes the same messages."
        ),
        "content": {"application/msgpack": {"schema": {"type": "string", "format": "binary"}}},
    }
}

REFINE: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {"type": "object", "required": ["iterations"]},
                "example": {"iterations": 2000},
            }
        },
    }
}


def binary(*media_types: str) -> dict[int | str, dict[str, Any]]:
    """Responses of a route that answers bytes."""
    schema = {"schema": {"type": "string", "format": "binary"}}
    return {200: {"content": dict.fromkeys(media_types, schema)}}
