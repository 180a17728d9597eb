// Laws of plugins checked in a process of their own, which a plugin may end.
#pragma once

#include <functional>
#include <string>

#include "plugin/check/law_suite.h"

namespace semfield::app {

/// Calls `laws` in a process forked from this one, so before any thread is there, and `on_row` here for each row that
/// it tells of. A process that ends before `laws` has returned, whatever its exit code, breaks the law under way: the
/// last row says so. Throws the Error that `laws` throws, and Error(unavailable) for a process that ends before the
/// first law: `file` did not load.
void ask_laws_apart(const std::string& file, const std::function<void(LawRequest&)>& laws,
                    const std::function<void(const LawRow&)>& on_row);

}  // namespace semfield::app
