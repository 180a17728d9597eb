// Per-device tables of function pointers: how a plugin swaps CPU and CUDA kernels without a conditional.
#pragma once

#include <map>
#include <string>
#include <string_view>
#include <typeindex>
#include <utility>
#include <vector>

#include "core/view.h"

namespace semfield {

std::string_view device_name(Device device);

/// Tables are keyed by their own type (e.g. HashGridKernels<float>) and device; a plugin's `*_cpu.cpp` adds the CPU
/// one, its
/// `*_cuda.cu`, when built, the CUDA one.
class KernelTables {
 public:
  /// `owner` as in messages: "encoder 'hash_grid'". `table` must live as long as the program.
  template <class Table>
  void add(Device device, std::string_view owner, const Table* table) {
    add_erased(typeid(Table), device, owner, table);
  }
  /// Throws Error(unavailable): "encoder 'hash_grid' has no cuda kernels in this build (has: cpu)".
  template <class Table>
  const Table& get(Device device, std::string_view owner) const {
    return *static_cast<const Table*>(get_erased(typeid(Table), device, owner));
  }
  /// Devices that `owner` has kernels for, e.g. "cpu, cuda".
  std::string devices_of(std::string_view owner) const;

 private:
  void add_erased(std::type_index type, Device device, std::string_view owner, const void* table);
  const void* get_erased(std::type_index type, Device device, std::string_view owner) const;
  std::map<std::pair<std::type_index, Device>, const void*> tables_;
  std::map<std::string, std::vector<Device>, std::less<>> owners_;
};

}  // namespace semfield
