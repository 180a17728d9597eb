// The sections `runtime` and `report`.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/half.h"
#include "core/view.h"

namespace semfield {

SEMFIELD_CHOICES(Precision, "fp32", "bf16", "auto");

struct RuntimeParams {
  std::string device = "auto";  ///< or what device_of reads (core/view.h)
  Precision precision = Precision::fp32;
  bool deterministic = false;
  int threads = 0;
  std::uint32_t seed = 1;
  int lanes = 0;
  int tile_rays = 0;
  std::vector<std::string> keep;
  double memory_gb = 0;
  bool fold_feature_layer = true;
  bool direction_once_per_ray = true;
  bool deferred_class_layer = true;
};

inline void describe(ParamVisitor& visit, RuntimeParams& p) {
  SEMFIELD_PARAM(visit, p, device,
                 "where kernels run: auto, cpu, cuda, or cuda:N for GPU N, counted from 0; auto takes the fastest that "
                 "this build and machine have");
  SEMFIELD_PARAM(
      visit, p, precision,
      "precision of the networks' matrix products: fp32; bf16 operands with fp32 sums, weights and gradients; or auto, "
      "which is bf16 where the machine computes it faster and all fields have it, and run.yaml has the choice");
  SEMFIELD_PARAM(visit, p, deterministic,
                 "a GPU sums in a fixed order, so that every run gives the same bits; the CPU always does");
  SEMFIELD_PARAM(visit, p, threads, "CPU threads, 0: every core; results do not depend on it", {0, 4096});
  SEMFIELD_PARAM(visit, p, seed, "seed of every random value");
  SEMFIELD_PARAM(visit, p, lanes,
                 "gradient slots, which also limit the threads of a step; 0: from the work of a step, up to 48, and "
                 "run.yaml has the number; changes the order of sums",
                 {0, 256});
  SEMFIELD_PARAM(visit, p, tile_rays, "rays per tile; 0: from the samplers; changes the order of sums", {0, 1 << 16});
  SEMFIELD_PARAM(
      visit, p, keep,
      "components to build although the scene does not need them, like --keep; `train --dry-run` names them");
  SEMFIELD_PARAM(
      visit, p, memory_gb,
      "most memory that training may take, GB; 0: no limit; images larger than this, or than what is free, are refused "
      "before they are read, and a run that takes more ends after its first steps",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, fold_feature_layer, "multiply a field's feature and view layer once per step (exact)");
  SEMFIELD_PARAM(visit, p, direction_once_per_ray, "compute the view layer's direction term once per ray (exact)");
  SEMFIELD_PARAM(visit, p, deferred_class_layer, "apply the class layer once per ray, after compositing (exact)");
}

inline void validate(const RuntimeParams& p, Diagnostics& diagnostics) {
  if (p.device == "auto" || device_of(p.device)) return;
  diagnostics.error("config.value.choice", "runtime.device",
                    "expected one of auto, cpu, cuda, or cuda:N for GPU N counted from 0, got '" + p.device + "'",
                    near_name_remedy(p.device, {"auto", "cpu", "cuda"}, "write one of them"));
}

struct ReportParams {
  std::int64_t log_every_steps = 20;
  double eval_every_s = 10;
  int eval_frames = 4;
  double eval_share = 0.1;
  int eval_stride = 1;
  double checkpoint_every_s = 60;
  int keep_checkpoints = 2;
  int strips = 4;
  int training_frames = 0;
  int worst_frames = 2;
};

inline void describe(ParamVisitor& visit, ReportParams& p) {
  SEMFIELD_PARAM(visit, p, log_every_steps, "steps between rows of metrics.jsonl", {1, 1e9});
  SEMFIELD_PARAM(visit, p, eval_every_s, "seconds of training between evaluations on test frames; 0: only at the end",
                 {0, 1e8});
  SEMFIELD_PARAM(visit, p, eval_frames,
                 "test frames of an evaluation while training, evenly spaced; the last one takes all", {1, 1e6});
  SEMFIELD_PARAM(
      visit, p, eval_share,
      "share of the training time that evaluation may take; to stay within it, evaluations become rarer and read "
      "fewer pixels; so does the last one of a run with train.time_s, of every test frame, and says so; 0: no bound",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, eval_stride,
                 "every N-th pixel, across and down, that the last evaluation scores; it then is one of a sample",
                 {1, 64});
  SEMFIELD_PARAM(visit, p, checkpoint_every_s, "seconds between checkpoints; 0: only at the end", {0, 1e8});
  SEMFIELD_PARAM(visit, p, keep_checkpoints, "checkpoints that stay on disk", {2, 1e6});
  SEMFIELD_PARAM(visit, p, strips, "test frames shown in the report", {0, 64});
  SEMFIELD_PARAM(
      visit, p, training_frames,
      "training frames, evenly spaced, on which the field and the training labels are scored at the end against "
      "the scene's own labels; 0: none",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, worst_frames, "test frames with the lowest scores shown in the report", {0, 64});
}

}  // namespace semfield
