// How much CPU time a control group allows, as whole cores.
#pragma once

#include <string>

namespace semfield {

/// Cores' worth of time that Linux control groups grant this process, rounded up: the smallest of its group and the
/// groups above, version 2 (cpu.max) or 1 (cpu.cfs_quota_us); 0 = no limit, or none that can be read. `groups` is the
/// text of /proc/self/cgroup, `root` where the groups are mounted.
int cpu_quota(const std::string& groups, const std::string& root);
/// Of this process.
int cpu_quota();

}  // namespace semfield
