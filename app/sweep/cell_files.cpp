#include "app/sweep/cell_files.h"

#include <cerrno>
#include <filesystem>
#include <utility>

#include "system/files.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

std::string file_of_cell(const std::string& sweep_folder, const std::string& id, const char* name) {
  return (fs::path(cell_folder(sweep_folder, id)) / name).string();
}

constexpr const char* kResult = "result.json";
constexpr const char* kFailure = "failure.txt";

}  // namespace

std::string cell_folder(const std::string& sweep_folder, const std::string& id) {
  return (fs::path(sweep_folder) / "cells" / id).string();
}

std::optional<CellValues> result_of_cell(const std::string& sweep_folder, const std::string& id) {
  return read_cell_result(file_of_cell(sweep_folder, id, kResult));
}

void write_cell_failure(const std::string& sweep_folder, const std::string& id, const std::string& failure) {
  write_file_atomic(file_of_cell(sweep_folder, id, kFailure), failure + "\n");
}

void forget_cell_failure(const std::string& sweep_folder, const std::string& id) {
  const std::string file = file_of_cell(sweep_folder, id, kFailure);
  std::error_code failed;
  fs::remove(file, failed);
  if (failed) throw write_error("remove", file, failed.value());
}

bool notice_cell(EndedCells& ended, const std::string& sweep_folder, const std::string& id) {
  if (ended.has(id)) return true;
  bool done = false, failed = false;
  // By listing the folder: on NFS this queries the server, which looking for a file need not do for a minute.
  std::error_code not_there;
  for (const fs::directory_entry& entry : fs::directory_iterator(cell_folder(sweep_folder, id), not_there)) {
    done = done || entry.path().filename() == kResult;
    failed = failed || entry.path().filename() == kFailure;
  }
  if (done) {
    if (std::optional<CellValues> values = result_of_cell(sweep_folder, id)) ended.results[id] = std::move(*values);
  } else if (failed) {
    std::string failure = read_text_file(file_of_cell(sweep_folder, id, kFailure));
    if (failure.ends_with('\n')) failure.pop_back();
    ended.failures[id] = std::move(failure);
  }
  return ended.has(id);
}

}  // namespace semfield::app
