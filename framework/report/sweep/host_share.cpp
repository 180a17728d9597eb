#include "report/sweep/host_share.h"

#include <algorithm>
#include <cstddef>

#include "core/device_id.h"
#include "core/error.h"

namespace semfield {

int cells_at_a_time(int own, int cores, int processes, int threads) {
  const int share = std::max(1, std::min(own, cores / std::max(1, processes)));
  return std::max(1, share / std::max(1, threads));
}

std::vector<std::string> devices_of_process(const std::vector<std::string>& devices, int rank, int size) {
  std::vector<std::string> own;
  for (std::size_t i = static_cast<std::size_t>(rank); i < devices.size(); i += static_cast<std::size_t>(size))
    own.push_back(devices[i]);
  return own;
}

std::string free_device(const std::vector<std::string>& devices, const std::vector<std::string>& busy) {
  const auto is_free = [&](const std::string& device) {
    return std::find(busy.begin(), busy.end(), device) == busy.end();
  };
  const auto found = std::find_if(devices.begin(), devices.end(), is_free);
  return found == devices.end() ? "" : *found;
}

std::vector<std::string> device_names(const std::vector<std::string>& words) {
  std::vector<std::string> names;
  for (const std::string& word : words) {
    const std::optional<DeviceId> id = device_of(word.starts_with("cuda") ? word : "cuda:" + word);
    if (!id || word == "cuda")
      throw Error(ErrorKind::usage, "usage.value.devices", "--devices: '" + word + "' is not a CUDA device",
                  "write all, or numbers with commas between them: 0,1");
    const std::string name = "cuda:" + std::to_string(id->ordinal);
    if (std::find(names.begin(), names.end(), name) != names.end())
      throw Error(ErrorKind::usage, "usage.value.devices", "--devices: '" + word + "' is named twice",
                  "name every device once");
    names.push_back(name);
  }
  return names;
}

}  // namespace semfield
