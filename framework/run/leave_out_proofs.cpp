#include <nlohmann/json.hpp>

#include "run/run_folder.h"

namespace semfield {

namespace {
// The file itself, taken in when the library is built.
constexpr const char* kTable =
#include "leave_out_table.inc"
    ;
}  // namespace

std::string shipped_saving(const std::string& component) {
  static const nlohmann::json table = nlohmann::json::parse(kTable);
  std::string found;  // the last of a component's rows: those before it prove, on fields made for that
  for (const auto& row : table.at("rows")) {
    if (row.at("component") == component) found = row.at("saving_measured").get<std::string>();
  }
  return found.empty() ? found : found + "; of docs/reference/leave_out.md, not of this run";
}

}  // namespace semfield
