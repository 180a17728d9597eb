// What the suite of stiff and extreme cases hands to `bench numerics`: the suite is a library of its own, loaded when
// asked for.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "plugin/registry.h"

namespace semfield::app {

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
