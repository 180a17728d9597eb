#include "core/work_scope.h"

namespace semfield {

namespace {

// A thread's own, so that two sessions in two threads do not meet here.
thread_local const WorkSettings* t_settings = nullptr;

}  // namespace

const WorkSettings& work_settings() {
  static const WorkSettings defaults;
  return t_settings != nullptr ? *t_settings : defaults;
}

WorkScope::WorkScope(const WorkSettings& settings) : before_(t_settings) { t_settings = &settings; }
WorkScope::~WorkScope() { t_settings = before_; }

}  // namespace semfield
