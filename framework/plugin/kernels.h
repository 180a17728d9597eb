// Tables of function pointers by device and precision: how a plugin swaps kernels without a conditional.
#pragma once

#include <compare>
#include <functional>
#include <map>
#include <string>
#include <string_view>
#include <typeindex>
#include <typeinfo>
#include <vector>

#include "core/half.h"
#include "core/view.h"

namespace semfield {

std::string_view device_name(Device device);
std::string_view precision_name(Precision precision);

/// Owner of the kernels of plugin/mlp.
inline constexpr std::string_view kMlpOwner = "network 'mlp'";
/// Owner of those of plugin/head.
inline constexpr std::string_view kHeadOwner = "network 'head'";

/// Tables are keyed by their own type (e.g. WavesKernels<float>), device and precision; a plugin's `*_cpu.cpp` adds
/// the CPU ones, its `*_cuda.cu`, when built, the CUDA ones. Kernels without matrix products have fp32 tables alone.
class KernelTables {
 public:
  /// `owner` as in messages: "encoder 'waves'". `table` must live as long as the program.
  template <class Table>
  void add(Device device, std::string_view owner, const Table* table, Precision precision = Precision::fp32) {
    add_erased({typeid(Table), device, precision}, owner, table);
  }
  /// Throws Error(unavailable): "encoder 'waves' has no cuda kernels in this build (has: cpu)".
  template <class Table>
  const Table& get(Device device, std::string_view owner, Precision precision = Precision::fp32) const {
    return *static_cast<const Table*>(get_erased({typeid(Table), device, precision}, owner));
  }
  /// The same, or null.
  template <class Table>
  const Table* find(Device device, Precision precision = Precision::fp32) const {
    const auto found = tables_.find({typeid(Table), device, precision});
    return found == tables_.end() ? nullptr : static_cast<const Table*>(found->second);
  }
  /// `owner` is put together from the blocks of `block`: it has kernels where that has some, in bf16 if `in_bf16`.
  void compose(std::string_view owner, std::string_view block, bool in_bf16) {
    blocks_[std::string(owner)] = {std::string(block), in_bf16};
  }
  /// True when `owner` has kernels for the device, in some precision or in this one.
  bool has(Device device, std::string_view owner) const;
  bool has(Device device, std::string_view owner, Precision precision) const;
  /// What `owner` has kernels for, e.g. "cpu, cpu bf16, cuda"; fp32 goes without saying.
  std::string devices_of(std::string_view owner) const;

 private:
  struct Key {
    std::type_index type;
    Device device;
    Precision precision;
    auto operator<=>(const Key&) const = default;
  };
  void add_erased(const Key& key, std::string_view owner, const void* table);
  const void* get_erased(const Key& key, std::string_view owner) const;
  std::map<Key, const void*> tables_;
  std::vector<std::string> variants_of(std::string_view owner) const;
  std::map<std::string, std::vector<std::string>, std::less<>> owners_;
  struct Block {
    std::string name;
    bool in_bf16 = true;
  };
  std::map<std::string, Block, std::less<>> blocks_;
};

}  // namespace semfield

/// Last line of a plugin's NAME_cpu.cpp, in namespace SEMFIELD_ISA: adds `table<float>` and `table<double>`.
#define SEMFIELD_CPU_KERNELS(name, owner, table)                \
  void name##_cpu_kernels(::semfield::KernelTables& tables);    \
  void name##_cpu_kernels(::semfield::KernelTables& tables) {   \
    tables.add(::semfield::Device::cpu, owner, &table<float>);  \
    tables.add(::semfield::Device::cpu, owner, &table<double>); \
  }
