// Peak memory of a training run, predicted before the network is allocated: by item, against what is available, with
// settings that would fit.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "session/assembly.h"
#include "session/settings/run_config.h"

namespace semfield {

struct MemoryItem {
  std::string name;
  std::size_t bytes = 0;
};

/// What a process that opened a scene holds already, as measured.
struct MemoryFacts {
  std::size_t program = 0;  ///< resident before the scene was opened
  std::size_t frames = 0;   ///< pixels and labels in memory
  std::size_t loaded = 0;   ///< resident with the scene
  std::size_t loading = 0;  ///< peak while it was read
  std::size_t pixels = 0;   ///< of the largest frame
  std::int64_t train_pixels = 0;
  int classes = 0;
};

/// The peak is that of loading, or what is held plus the largest of the things that take turns.
struct MemoryPlan {
  std::vector<MemoryItem> held;
  std::vector<MemoryItem> turns;
  std::size_t loading = 0;

  std::size_t peak() const;
  const MemoryItem& largest() const;  ///< of those held
};

MemoryPlan plan_memory(const RunConfig& config, const MemoryFacts& facts, const NetworkPlan& network);

/// Bytes that this process may hold in all: what it holds plus what the system leaves, and at most `memory_gb` when
/// that is above 0.
std::size_t allowed_memory(double memory_gb);

/// Up to three settings, each of which alone brings the peak below `allowed`: "train.rays=512 (now 4096)", the mildest
/// first. `config` is changed while they are tried and comes back as it was.
std::vector<std::string> settings_that_fit(RunConfig& config, const Registry& registry, const BuildPlan& plan,
                                           const SceneExtent& extent, const MemoryFacts& facts, std::size_t allowed);

/// Throws Error(unavailable) when the peak is above what is allowed: needed, allowed, the largest item, settings that
/// fit.
void require_memory(RunConfig& config, const Registry& registry, const BuildPlan& plan, const SceneExtent& extent,
                    const MemoryFacts& facts, const MemoryPlan& memory);

/// Before pixels are read: throws Error(unavailable) when frames of `frame_bytes` in all, `frames` of them up to
/// `width_px` wide, do not fit.
void require_frame_memory(const RunConfig& config, std::size_t frame_bytes, std::size_t frames, int width_px);

/// Lines of the table, each ended.
std::string memory_table(const MemoryPlan& plan, std::size_t allowed);

}  // namespace semfield
