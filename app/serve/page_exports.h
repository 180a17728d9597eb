// Exports that the page asks for: a checkpoint, then this program's own verbs as a process beside the training.
#pragma once

#include <atomic>
#include <cstdint>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "app/serve/page_requests.h"
#include "app/serve/page_source.h"
#include "app/serve/page_state.h"

namespace semfield::app {

struct ExportOptions {
  std::string program;  ///< file of this program
  std::string run_dir;
  std::vector<std::string> modules;  ///< files of plugins that the run needs
};

/// Exports lie in RUN/export/ID/ and stay there. One is made at a time.
class PageExports {
 public:
  PageExports(PageSource& source, ExportOptions options) : source_(source), options_(std::move(options)) {}
  /// Ends the process of an export that is being made.
  ~PageExports();
  PageExports(const PageExports&) = delete;
  PageExports& operator=(const PageExports&) = delete;

  /// The id of the export that was begun. Throws Error: unavailable while another is made, write_error for its folder.
  std::string start(ExportKind kind);
  std::vector<ExportState> list() const;
  /// Grows with every change of the list.
  std::uint64_t changes() const { return changes_; }
  /// Path of file `number` of an export that is done; "" where there is none.
  std::string file(const std::string& id, std::uint64_t number) const;

 private:
  void make(ExportKind kind, std::string id);
  void run_verb(ExportKind kind, const std::string& id);
  std::vector<std::string> words(ExportKind kind, const std::string& folder) const;
  void pack_labels(const std::string& folder) const;
  void tell(const std::string& id, const std::string& state, const std::string& text,
            const std::vector<std::string>& files = {});
  std::string folder_of(const std::string& id) const { return options_.run_dir + "/export/" + id; }

  PageSource& source_;
  ExportOptions options_;
  mutable std::mutex mutex_;
  std::vector<ExportState> list_;
  std::atomic<std::uint64_t> changes_{0};
  std::atomic<bool> stopping_{false};
  std::thread maker_;
};

}  // namespace semfield::app
