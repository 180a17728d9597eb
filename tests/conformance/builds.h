// How the plugin of a row is built for its laws, and its twin in double on the CPU.
#pragma once

#include <gtest/gtest.h>

#include "testkit/laws.h"
#include "tests/conformance/rows.h"

namespace semfield::testkit {

/// "", or "encoder 'waves' has no cuda kernels": a plugin of the CPU alone is left out of a device's laws by
/// name.
inline std::string lacks_kernels(const Registry& registry, PluginKind kind, const std::string& name, Device device) {
  const std::string owner = std::string(kind_name(kind)) + " '" + name + "'";
  if (registry.kernels().has(device, owner)) return {};
  return owner + " has no " + std::string(device_name(device)) + " kernels";
}

template <class Build>
auto make_twins(const Registry& registry, const Row& row, const Build& build) {
  return make_twins(registry, row.name, row.settings, build);
}

/// Ways of building that a factory may refuse with an Error; at least one must be accepted. `laws` gets the twins of
/// each that is.
template <class Build, class Laws>
void hold_for_any_accepted(const Registry& registry, const Row& row, const std::vector<Build>& builds,
                           const Laws& laws) {
  int accepted = 0;
  std::string refusals;
  for (const Build& build : builds) {
    decltype(make_twins(registry, row, build)) twins;
    try {
      twins = make_twins(registry, row, build);
    } catch (const Error& error) {
      refusals += std::string(error.what()) + "\n";
      continue;
    }
    ++accepted;
    SCOPED_TRACE("variant " + std::to_string(&build - builds.data()));
    const Failures failures = laws(*twins.single, *twins.oracle, build);
    EXPECT_TRUE(failures.empty()) << to_text(failures);
  }
  EXPECT_GT(accepted, 0) << "every way of building was refused:\n" << refusals;
}

}  // namespace semfield::testkit
