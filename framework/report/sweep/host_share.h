// What one of several processes of a sweep takes of its host: cores and devices.
#pragma once

#include <string>
#include <vector>

namespace semfield {

/// Cells at a time of a process that may run on `own` of its host's `cores`, which `processes` of the sweep share, with
/// `threads` for each cell; at least 1.
int cells_at_a_time(int own, int cores, int processes, int threads);

/// Devices of the `rank`-th of `size` processes on one host: every size-th, from the rank-th on. So each belongs to one
/// process, and none is left over.
std::vector<std::string> devices_of_process(const std::vector<std::string>& devices, int rank, int size);

/// The device for the next cell: the first that is not in `busy`, "" where all are.
std::string free_device(const std::vector<std::string>& devices, const std::vector<std::string>& busy);

/// Names of devices as `runtime.device` takes them, from "0" or "cuda:0". Throws Error(usage) for anything else and for
/// one named twice.
std::vector<std::string> device_names(const std::vector<std::string>& words);

}  // namespace semfield
