// The cells of a sweep: every run that its tables need, each once however many tables show it.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "plugin/registry.h"
#include "report/sweep/sweep_file.h"

namespace semfield {

/// One figure of a table: indices into the sweep.
struct CellUse {
  std::size_t experiment = 0, scene = 0, variant = 0, seed = 0;
};

/// One run. Its id is a hash of all that its result depends on - the resolved configuration, what is scored, how labels
/// are fused - so equal runs of several experiments are one cell, and a changed configuration is another one.
struct Cell {
  std::string id;      ///< 16 hexadecimal digits; the folder's name
  std::string config;  ///< resolved YAML
  std::string split;
  std::string scene;  ///< name, for messages
  std::string pack;   ///< hash of the scene's own section: cells with the same one share a packed file; empty: none
  std::string label;  ///< "experiment / variant", of the first use
  std::int64_t seed = 0;
  FuseCell fuse;           ///< method empty: train, or find objects
  bool objects = false;    ///< find objects in the run of field_cell
  std::string field_cell;  ///< id of the cell whose field gives the depth, or the objects; empty: none
  std::vector<CellUse> uses;

  bool trains() const { return !objects && fuse.method.empty(); }
};

/// Cells in the order of the tables; those that others wait for come first. Seeds go to runtime.seed and
/// scene.labels.seed. Throws Error(config) with every error of every cell's configuration, each named once.
std::vector<Cell> plan_cells(const Sweep& sweep, Registry& registry);

/// `config` with its dataset replaced by `reader` (Registry::pack_reader) of the packed scene `file`; labels and sizes
/// stay.
std::string with_packed_scene(const std::string& config, const std::string& reader, const std::string& file);

}  // namespace semfield
