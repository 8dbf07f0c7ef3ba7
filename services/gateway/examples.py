"""What OpenAPI cannot see in the code: binary bodies, and examples that work as they are."""

from __future__ import annotations

import json
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

_COVARIANCE = [5e-6 if i % 7 == 0 else 0.0 for i in range(36)]

LOCALIZE: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": (
            "A msgpack map: rgb {encoding, bytes}, depth? {encoding, bytes, scale?}, "
            "T_map_camera_prior? {position, orientation} (where the camera is thought to be), and "
            "for another device than the session's its calibration? or, for colour alone, its "
            'camera? {"intrinsics": {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, '
            '"width": 640, "height": 480}, "distortion": []}. Images as in POST .../frames.'
        ),
        "content": {"application/msgpack": {"schema": {"type": "string", "format": "binary"}}},
    },
    "responses": {
        "200": {
            "content": {
                "application/json": {
                    "examples": {
                        "found": {
                            "value": {
                                "status": "LOCALISED",
                                "reason": "",
                                "T_map_camera": {
                                    "position": {"x": 0.4, "y": -0.1, "z": 1.9},
                                    "orientation": {"x": 0.0, "y": 0.38, "z": 0.0, "w": 0.92},
                                },
                                "pos_std_m": 0.004,
                                "rot_std_deg": 0.1,
                                "covariance": _COVARIANCE,
                                "inliers": 412,
                                "inlier_share": 0.93,
                                "reference_seq": 120,
                                "map_revision": 58,
                                "timings_ms": {"orb": 9.1, "total": 52.0},
                            }
                        },
                        "not found": {
                            "value": {
                                "status": "NOT_LOCALISED",
                                "reason": "no keyframe looks like this",
                                "T_map_camera": None,
                                "map_revision": 58,
                            }
                        },
                    }
                }
            }
        }
    },
}

_POSE = {
    "position": {"x": 0.4, "y": -0.1, "z": 1.9},
    "orientation": {"x": 0.0, "y": 0.38, "z": 0.0, "w": 0.92},
}
_TIMED_POSE = {
    "seq": 120,
    "t_ns": 4_000_000_000,
    "status": "TRACKED",
    "frame": "opencv",
    "T_map_camera": _POSE,
    "T_map_odom": None,
    "pos_std_m": 0.004,
    "rot_std_deg": 0.1,
    "reference_seq": 112,
    "map_revision": 58,
    "is_interpolated": False,
}


def _answer(media_type: str, example: Any, status: int = 200) -> dict[int | str, dict[str, Any]]:
    return {status: {"content": {media_type: {"example": example}}}}


POSE = _answer("application/json", _TIMED_POSE)

POSE_EVENTS = _answer("text/event-stream", f"event: pose\ndata: {json.dumps(_TIMED_POSE)}\n\n")

GEOPOSE = _answer(
    "application/json",
    {
        "position": {"lat": 48.2621, "lon": 11.6679, "h": 482.3},
        "quaternion": {"x": -0.65, "y": 0.27, "z": 0.27, "w": 0.65},
        "accuracy": {"pos_std_m": 0.004, "rot_std_deg": 0.1},
        "frame": "opencv",
        "t_ns": 4_000_000_000,
        "status": "TRACKED",
    },
)

GEOREFERENCE: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {"type": "object", "required": ["lat", "lon", "h"]},
                "examples": {
                    "by compass": {
                        "value": {"lat": 48.2621, "lon": 11.6679, "h": 482.3, "heading_deg": 45.0}
                    },
                    "whole": {
                        "value": {"lat": 48.2621, "lon": 11.6679, "h": 482.3, "T_enu_map": _POSE}
                    },
                },
            }
        },
    }
}

TICKET: dict[int | str, dict[str, Any]] = {
    201: {
        "content": {
            "application/json": {
                "example": {
                    "ticket": "tNZ1PQjWZ2cLMH2mGVdNsX3IRsE7Lp3Dh8CXoyn6A2k",
                    "expires_in_s": 30.0,
                }
            }
        }
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


RENDER_PATH: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {"type": "object"},
                "examples": {
                    "past the keyframes": {"value": {"frames": 60, "width": 320}},
                    "as it was walked": {
                        "value": {"path": "trajectory", "frames": 60, "format": "mp4"}
                    },
                    "around what is in the middle": {
                        "value": {"path": "orbit", "turn_deg": 30.0, "frames": 30}
                    },
                    "pictures of given views": {
                        "value": {"path": "poses", "poses": [_POSE], "frames": 1, "format": "png"}
                    },
                },
            }
        },
    },
}


def binary(*media_types: str) -> dict[int | str, dict[str, Any]]:
    """Responses of a route that answers bytes."""
    schema = {"schema": {"type": "string", "format": "binary"}}
    return {200: {"content": dict.fromkeys(media_types, schema)}}
