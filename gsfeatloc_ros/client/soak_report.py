"""What a soak has shown, in figures, and whether the targets were reached."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsfeatloc_ros.client.flood import Flood, FloodReply, summarize_flood
from gsfeatloc_ros.client.observer import Call, Sample, SoakRecord
from gsfeatloc_ros.client.score import MAX_ROTATION_ERROR_DEG, MAX_TRANSLATION_ERROR, pose_error

# Seconds after which memory is not to grow any more.
_WARM_UP = 60.0
# Blocks of time that are compared by their memory.
_BLOCKS = 12
# The targets: share of images received; latency of a service in times of a localization; megabytes a minute, and
# share in all, by which memory may seem to grow.
_MIN_RECEPTION = 0.95
_MAX_LATENCY = 1.5
_MAX_GROWTH, _MAX_RISE = 0.1, 0.05
# Cores' time that may be taken of each core allowed, over so many seconds.
_MAX_CORES, _CORE_SECONDS = 1.1, 5.0
# With a flood: megabytes that are resident at most, and the share of its quiet rate that the stream keeps at least.
_MAX_FLOOD_MEMORY, _MIN_STREAM_SHARE = 700.0, 0.3


def growth(samples: list[Sample]) -> float:
    """Return how fast memory grows all the time, in megabytes a minute.

    The median of the rises between the medians of blocks of time: a leak makes most of them rise. The allocator's
    steps to another high-water mark, at the first far prior for instance, make a few rise; _MAX_RISE is the bound of
    those. Single samples depend on what was localized just then.
    """
    blocks = np.array_split(np.array([(sample.seconds / 60, sample.memory) for sample in samples]), _BLOCKS)
    minutes, medians = np.array([np.median(block, axis=0) for block in blocks]).T
    return float(np.median(np.diff(medians) / np.diff(minutes)))


def most_cores(samples: list[Sample]) -> float:
    """Return how many cores' time was taken at most over _CORE_SECONDS."""
    seconds, used = np.array([(sample.seconds, sample.cpu) for sample in samples]).T
    ends = np.searchsorted(seconds, seconds + _CORE_SECONDS)
    pairs = [(start, end) for start, end in enumerate(ends) if end < len(seconds)]
    return max(((used[end] - used[start]) / (seconds[end] - seconds[start]) for start, end in pairs), default=np.nan)


def last_rise(samples: list[Sample]) -> float:
    """Return the second at which memory came within a megabyte of the most that it was."""
    most = max(sample.memory for sample in samples)
    return next(sample.seconds for sample in samples if sample.memory > most - 1.0)


def summarize_calls(calls: list[Call], typical: float) -> dict[str, float]:
    """Return latencies of a service, also as multiples of a `typical` localization (milliseconds) and of their own."""
    latency, work = np.array([(call.latency, call.work) for call in calls]).T
    figures = {
        "ms_median": np.median(latency),
        "ms_max": np.max(latency),
        "times_median": np.median(latency) / typical,
        "times_95_percent": np.percentile(latency, 95) / typical,
        "times_max": np.max(latency) / typical,
    }
    # Where it is told, and there was any.
    worked = work > 0
    if worked.any():
        # Beyond the localization itself: waiting, and the way there and back.
        beside = (latency - work)[worked]
        figures |= {"ms_beside_work_median": np.median(beside), "ms_beside_work_max": np.max(beside)}
        figures |= {"times_own_work_95_percent": np.percentile((latency / work)[worked], 95)}
    counts = {"calls": len(calls), "with_pose": sum(call.success for call in calls)}
    return counts | {name: round(float(value), 2) for name, value in figures.items()}


def summarize(record: SoakRecord, seconds: float) -> dict[str, Any]:
    """Return the figures of a record, and which targets it reaches; `seconds` is how long the stream was to last."""
    of_stream = [pose_error(record.sent[stamp], pose) for stamp, pose in record.answers.items()]
    degrees, metres = np.array(of_stream + record.errors).T
    wrong = int(((degrees > MAX_ROTATION_ERROR_DEG) | (metres > MAX_TRANSLATION_ERROR)).sum())
    sent, received = len(record.sent), record.counts["images_received"]
    typical = float(np.median(record.milliseconds))
    warm_up = min(_WARM_UP, seconds / 3)
    late = [sample for sample in record.samples if sample.seconds >= warm_up]
    warm, last = late[0], late[-1]
    leak = growth(late)
    services = {name: summarize_calls(calls, typical) for name, calls in record.calls.items()}
    return {
        "seconds": seconds,
        "images_sent": sent,
        "images_received": received,
        "reception": round(received / sent, 4),
        "images_dropped": record.counts["images_dropped"],
        "attempts": dict(record.statuses),
        "searches": record.searches,
        "answers": len(degrees),
        "answers_per_second": round(len(record.answers) / seconds, 2),
        "answers_wrong": wrong,
        "error_degrees_median": round(float(np.median(degrees)), 4),
        "error_degrees_max": round(float(np.max(degrees)), 4),
        "error_metres_median": round(float(np.median(metres)), 5),
        "error_metres_max": round(float(np.max(metres)), 5),
        "localization_ms_median": typical,
        "localization_ms_95_percent": round(float(np.percentile(record.milliseconds, 95)), 1),
        "latency_ms_median": round(float(np.median(record.latencies)), 1),
        "latency_ms_95_percent": round(float(np.percentile(record.latencies, 95)), 1),
        "worker_busy": round(sum(record.milliseconds) / 1e3 / last.seconds, 3),
        "services": services,
        "services_unanswered": record.unanswered,
        "memory_mb_after_warm_up": round(warm.memory, 1),
        "memory_mb_end": round(last.memory, 1),
        "memory_mb_per_minute": round(leak, 3),
        "memory_last_rise_second": last_rise(late),
        "heap_mb_after_warm_up": round(warm.heap, 1),
        "heap_mb_end": round(last.heap, 1),
        "threads": [warm.threads, last.threads],
        "files": [warm.files, last.files],
        "cpu_seconds": round(last.cpu - record.samples[0].cpu, 1),
        "cores_after_warm_up": round((last.cpu - warm.cpu) / (last.seconds - warm.seconds), 3),
        "cores_max": round(most_cores(record.samples), 3),
        "targets": {
            "memory does not grow": leak <= _MAX_GROWTH
            and last.memory <= (1 + _MAX_RISE) * warm.memory
            and last.threads <= warm.threads
            and last.files <= warm.files,
            "every answer is right": wrong == 0,
            "images are received": received >= _MIN_RECEPTION * sent,
            "services answer in time": record.unanswered == 0
            and all(
                max(service["times_median"], service.get("times_own_work_95_percent", 0.0)) < _MAX_LATENCY
                for service in services.values()
            ),
        },
    }


def add_core_target(result: dict[str, Any], threads: int) -> None:
    """Add to the targets that the localizer keeps to the cores that `cpu.threads` gives it."""
    result["targets"]["it keeps to its cores"] = bool(result["cores_max"] <= _MAX_CORES * threads)


def add_floods(result: dict[str, Any], record: SoakRecord, floods: list[tuple[Flood, list[FloodReply]]]) -> None:
    """Add to the figures how floods were answered, and what became of the stream meanwhile.

    Where all wait for each other, the services' own latencies are no target.
    """
    answered = np.sort([float(stamp) for stamp in record.answers])
    quiet = answered[answered < min(reply.sent for _, replies in floods for reply in replies)]
    quiet_rate = (len(quiet) - 1) / (quiet[-1] - quiet[0])
    result["floods"] = []
    for flood, replies in floods:
        # It lasts from its first request to its last reply.
        start = min(reply.sent for reply in replies)
        end = max(reply.sent + np.nan_to_num(1e-3 * reply.latency) for reply in replies)
        rate = np.count_nonzero((answered >= start) & (answered <= end)) / (end - start)
        figures = {"seconds": end - start, "stream_rate_quiet": quiet_rate, "stream_rate": rate}
        figures |= {"stream_share": rate / quiet_rate}
        rounded = {name: round(float(value), 3) for name, value in figures.items()}
        result["floods"].append(summarize_flood(flood, replies) | rounded)
    result["memory_mb_max"] = round(max(sample.memory for sample in record.samples), 1)
    del result["targets"]["services answer in time"]
    result["targets"] |= {
        "every request is answered": record.unanswered == 0
        and all(figures["unanswered"] == 0 for figures in result["floods"]),
        "the stream goes on": all(figures["stream_share"] >= _MIN_STREAM_SHARE for figures in result["floods"]),
        "memory is bounded": result["memory_mb_max"] <= _MAX_FLOOD_MEMORY,
    }
