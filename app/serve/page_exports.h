// Exports of the labelling page: this program's own verbs as processes beside it.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <list>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "app/serve/http_server.h"
#include "core/non_copyable.h"

namespace semfield::app {

/// One export, as the page shows it.
struct ExportState {
  std::string id;
  std::string what;                ///< "labels", "coco" or "mesh"
  std::string state = "waiting";   ///< then "running", then "done", "failed" or "canceled"
  std::string text;                ///< a short sentence
  std::vector<std::string> files;  ///< names, when it is done

  bool is_open() const { return state == "waiting" || state == "running"; }
};

struct ExportOptions {
  std::string program;  ///< file of this program
  std::string run_dir;
  std::vector<std::string> modules;  ///< files of plugins that the run needs
};

/// Exports lie in RUN/export/ID/ and stay there. Two are made side by side, the others wait for their turn.
class PageExports : NonCopyable {
 public:
  /// `save` writes a checkpoint, and returns when it is there.
  PageExports(std::function<void()> save, ExportOptions options)
      : save_(std::move(save)), options_(std::move(options)) {}
  /// Ends the processes of exports that are being made.
  ~PageExports();

  /// The id of the export that was begun or waits. Throws Error: data for a word that is none, unavailable where too
  /// many wait, write_error for its folder.
  std::string start(const std::string& what);
  /// Ends an export, whose id it returns; what is done stays. Throws Error(data) where there is none of this id.
  std::string cancel(const std::string& id);
  std::vector<ExportState> list() const;
  /// Grows with every change of the list.
  std::uint64_t changes() const { return changes_; }
  /// The answer to a request for "ID/NUMBER": that file, or 404.
  HttpResponse download(const std::string& place) const;

 private:
  // One export and the thread that waits for its turn and its program.
  struct Export {
    ExportState state;
    bool canceled = false;
    std::thread thread{};
  };
  void make(Export& one);
  void run_verb(Export& one);
  bool ends(const Export& one) const;
  void pack_labels(const std::string& folder) const;
  void tell(Export& one, const std::string& state, const std::string& text, const std::vector<std::string>& files = {});
  std::string folder_of(const std::string& id) const { return options_.run_dir + "/export/" + id; }

  std::function<void()> save_;
  ExportOptions options_;
  mutable std::mutex mutex_;  // of these four, but for the threads
  std::condition_variable turn_;
  std::list<Export> exports_;  // the earliest first
  int making_ = 0;
  bool stopping_ = false;
  std::atomic<std::uint64_t> changes_{0};
};

}  // namespace semfield::app
