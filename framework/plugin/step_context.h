// What every batch call knows: where it stands in the run, and the scratch memory it may use.
#pragma once

#include <cstdint>
#include <string_view>

#include "core/rng.h"
#include "core/workspace.h"

namespace semfield {

struct StepContext {
  std::uint64_t seed = 0;
  std::int64_t step = 0;
  bool training = false;           ///< false: no jitter, no noise; results depend on the inputs alone
  std::int64_t first_ray = 0;      ///< number of the call's ray 0 within the step's batch (or within the frame)
  std::uint32_t pass = 0;          ///< 0 = first (coarse) pass
  Workspace* workspace = nullptr;  ///< scratch of this lane; take inside a Workspace::Scope

  /// Address of random values of component `name` at this step and pass.
  RandomAddress random(std::string_view name) const {
    return {seed, static_cast<std::uint64_t>(step), stream_id(name) + 0x9E3779B9u * pass};
  }
};

}  // namespace semfield
