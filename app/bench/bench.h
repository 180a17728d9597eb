// What the verbs of `bench` hand to their libraries, which are loaded when one is asked for.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "app/verb.h"
#include "plugin/registry.h"

namespace semfield::app {

struct BenchOptions : Options {
  using Options::Options;
  const int& repeats = value_in("--repeats N", 5, 1, 1000, "rounds; figures are medians of them");
  const std::string& only = value("--only NAME", "measurements whose names begin with this: --only 'paper bf16'");
  const int& threads = value_in("--threads N", 0, 1, 4096, "CPU threads (default: every core)");
  const std::string& size =
      choice("--size SIZE", "full", {"full", "tiny"}, "full, or tiny: narrow networks and few rays, for tests");
  const std::vector<std::string>& set =
      repeated("--set KEY=VALUE", "override a value of every network: --set runtime.tile_rays=8");
};

/// `semfield_bench` of the library: measures on "cpu" or "cuda", prints, and returns the exit code.
using BenchFunction = int (*)(const BenchOptions& options, const char* device, AppContext& context);

// The suite of stiff and extreme cases, for `bench numerics`.

enum class NumericsStatus : std::uint8_t {
  passed,
  failed,
  absent,  ///< what the case is about does not exist in this build; says nothing either way
};

/// One case in one precision.
struct NumericsRow {
  std::string id;             ///< "A07"
  std::string name;           ///< "order-smooth"
  std::string precision;      ///< fp32, float64, bf16; "-" where no arithmetic is involved
  std::string what;           ///< the input, in a sentence
  std::string reference;      ///< what the result is compared with
  double error = 0;           ///< the measured error whose ratio to its tolerance is worst
  double tolerance = 0;       ///< of that error; both 0 where claims are exact
  double seconds = 0;         ///< of the row
  int checks = 0;             ///< comparisons and claims made
  std::string note;           ///< measured figures worth seeing, or the claim that failed, or why absent
  std::string known_failure;  ///< why the case is expected to fail; "" for all others
  NumericsStatus status = NumericsStatus::failed;
};

/// The suite's one symbol: runs the cases whose id begins with one of `ids` (empty: all), in order, into `rows`. Throws
/// Error(usage) for an id that no case begins with.
using NumericsSuite = void (*)(const Registry& registry, const std::vector<std::string>& ids,
                               std::vector<NumericsRow>& rows);
inline constexpr const char* kNumericsSuiteSymbol = "semfield_numerics_suite";

}  // namespace semfield::app
