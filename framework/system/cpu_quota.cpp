#include "system/cpu_quota.h"

#include <cmath>
#include <sstream>

#include "system/files.h"

namespace semfield {

namespace {

int cores_of(double quota_us, double period_us) {
  return quota_us > 0 && period_us > 0 ? static_cast<int>(std::ceil(quota_us / period_us)) : 0;
}

// One group's own limit. Version 2 writes "max 100000" or "150000 100000", version 1 two files and -1 for none.
int limit_of(const std::string& folder) {
  double quota_us = 0, period_us = 0;
  std::istringstream both(read_system_file(folder + "/cpu.max"));
  if (both >> quota_us >> period_us) return cores_of(quota_us, period_us);
  std::istringstream(read_system_file(folder + "/cpu.cfs_quota_us")) >> quota_us;
  std::istringstream(read_system_file(folder + "/cpu.cfs_period_us")) >> period_us;
  return cores_of(quota_us, period_us);
}

}  // namespace

int cpu_quota(const std::string& groups, const std::string& root) {
  int least = 0;
  std::istringstream lines(groups);
  for (std::string line; std::getline(lines, line);) {  // number:controllers:path; version 2 names no controller
    const std::size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos) continue;
    const std::string controllers = "," + line.substr(first + 1, second - first - 1) + ",";
    if (controllers != ",," && controllers.find(",cpu,") == std::string::npos) continue;
    const std::string mount = controllers == ",," ? root : root + "/cpu";
    for (std::string path = line.substr(second + 1);; path.resize(path.rfind('/'))) {
      if (path == "/") path.clear();
      const int limit = limit_of(mount + path);
      if (limit > 0 && (least == 0 || limit < least)) least = limit;
      if (path.rfind('/') == std::string::npos) break;
    }
  }
  return least;
}

int cpu_quota() { return cpu_quota(read_system_file("/proc/self/cgroup"), "/sys/fs/cgroup"); }

}  // namespace semfield
