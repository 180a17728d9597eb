// The registry of the plugins that a test links; the fuzzer includes it too, without GoogleTest.
#pragma once

#include "plugin/loader.h"
#include "plugin/registry.h"

namespace semfield::testkit {

/// Every plugin that this build links.
inline const Registry& linked_registry() {
  static const Registry registry = [] {
    Registry filled;
    register_linked_plugins(filled);
    return filled;
  }();
  return registry;
}

}  // namespace semfield::testkit
