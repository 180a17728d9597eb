// Pages over HTTP: every address below the secret folder, what it returns, and exports, which are this program's own
// verbs as processes beside it.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "app/serve/http_server.h"
#include "app/serve/page_requests.h"
#include "core/non_copyable.h"
#include "formats/image_io.h"
#include "serve/label_loop.h"
#include "serve/label_session.h"

namespace semfield::app {

/// One export, as the page shows it.
struct ExportState {
  std::string id;
  std::string what;                ///< export_name()
  std::string state = "waiting";   ///< then "running", then "done", "failed" or "canceled"
  std::string text;                ///< a short sentence
  std::vector<std::string> files;  ///< names, when it is done
};

struct ExportOptions {
  std::string program;  ///< file of this program
  std::string run_dir;
  std::vector<std::string> modules;  ///< files of plugins that the run needs
};

/// Exports lie in RUN/export/ID/ and stay there. Two are made side by side, the others wait for their turn.
class PageExports : NonCopyable {
 public:
  /// `save` writes a checkpoint, and returns when it is there; null where nothing trains.
  PageExports(std::function<void()> save, ExportOptions options)
      : save_(std::move(save)), options_(std::move(options)) {}
  /// Ends the processes of exports that are being made.
  ~PageExports();

  /// The id of the export that was begun or waits. Throws Error: unavailable where too many wait, write_error for its
  /// folder. `prepare` gets the folder before its program
  /// begins: a film's cameras are FOLDER/path.json.
  std::string start(ExportKind kind, const std::function<void(const std::string& folder)>& prepare = {});
  /// Ends an export; what is done stays. False: there is none of this id.
  bool cancel(const std::string& id);
  std::vector<ExportState> list() const;
  /// Grows with every change of the list.
  std::uint64_t changes() const { return changes_; }
  /// The answer to a request for "ID/NUMBER": that file, or 404.
  HttpResponse download(const std::string& place) const;

 private:
  // One export and the thread that waits for its turn and its program.
  struct Export {
    ExportKind kind;
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

/// 32 hexadecimal digits of 128 random bits from the kernel. Throws Error(unavailable) where it has none.
std::string new_token();

/// The token of a run: made once and kept in `run_dir`/serve_token, for its user alone, so that a page that is open
/// goes on when the program starts again. One that others may read is replaced. Throws as new_token, and write_error.
std::string kept_token(const std::string& run_dir);

// The page's own files, read once: what is not in the list is not there.

struct PageFile {
  std::string type;  ///< MIME
  std::string bytes;
};

/// Files of `folder` by name: scripts, styles, pages and pictures; "" is index.html. Throws Error(no_input) where the
/// folder or its index.html is missing.
std::map<std::string, PageFile> read_page_files(const std::string& folder);

// A run's id: by it a browser keeps what it has not sent yet, so that nothing enters another run.

/// 32 hexadecimal digits, made once and kept in `run_dir`/run_id beside the folder's place. A folder that was moved
/// keeps its id. A copy, whose original is still where it was, is another run: it gets an id of its own, and its
/// serve_token goes, so that a page of the original does not go on with the copy. Throws as new_token, and write_error.
std::string kept_run_id(const std::string& run_dir);

/// What the labelling page and the viewer have in common: an address with a secret, the places below it, and exports.
class PageHost : NonCopyable {
 public:
  virtual ~PageHost() = default;

  /// The address to open, with the token.
  std::string url() const;
  int port() const { return port_; }

 protected:
  struct Place {
    const char* method;
    std::function<HttpResponse(const HttpRequest&)> answer;
  };
  /// Files of exports are at `files`ID/NUMBER; `guide` describes the places.
  PageHost(std::function<void()> save, ExportOptions exports, std::string files, std::string guide)
      : exports_(std::move(save), std::move(exports)), files_(std::move(files)), guide_(std::move(guide)) {}
  /// Serves `places` when it returns; `next_port`: when the port is taken, one of the 99 behind it. Throws as free_port
  /// does. Answers may come until close(), which whoever inherits calls first when it ends.
  void open(std::string token, HttpOptions http, bool next_port, std::map<std::string, Place> places);
  void close() { http_.reset(); }

  PageExports exports_;

 private:
  // None: the request may go on. A wrong token gives 404 without a detail; what follows is for whoever knows the token.
  std::optional<HttpResponse> refuse(const HttpRequest& head) const;
  bool is_token(const std::string& path) const;
  bool is_host(const std::string& host) const;
  HttpResponse route(const HttpRequest& request);

  std::string files_, guide_, token_, address_;  // address and port: what the server is bound to
  int port_ = 0;
  std::map<std::string, Place> places_;
  std::unique_ptr<HttpServer> http_;
};

// The labelling page.

/// Milliseconds since 1970.
std::int64_t now_ms();

struct PageOptions {
  HttpOptions http;
  bool next_port = false;  ///< when http.port is taken, one of the 99 behind it
  ExportOptions exports;
  std::map<std::string, PageFile> files;
  std::uint64_t first_revision = 0;  ///< added to every revision; above all of an earlier server of the run
  std::string token;                 ///< new_token()
  std::string run_id;                ///< kept_run_id()
  int longest_poll_ms = 20000;       ///< how long a request for news waits
};

class PageServer final : public PageHost {
 public:
  /// Serves when it returns; the source must outlive it. Throws as free_port does.
  PageServer(LabelSource& source, PageOptions options);
  /// Requests that wait for news get a response, pictures are waited for.
  ~PageServer() override;

  /// Requests for news no longer wait: the session ends.
  void end_waiting() { stopping_ = true; }

 private:
  HttpResponse get_state(const HttpRequest& request) const;
  HttpResponse get_photo(const HttpRequest& request) const;
  HttpResponse post_event(const HttpRequest& request);
  HttpResponse post_picture(const HttpRequest& request);
  HttpResponse post_export(const HttpRequest& request);
  int view_of(const HttpRequest& request) const;
  void check_view(std::uint64_t view) const;

  LabelSource& source_;
  PageOptions options_;
  std::atomic<bool> stopping_{false};
  mutable std::atomic<int> waiting_for_news_{0};
};

// Pictures of responses.

inline constexpr int kMostPageClasses = 255;  ///< a palette has an entry for each and one for none

/// Class indices as a palette PNG: entry index + 1 has the class's colour, entry 0 is transparent and means none.
std::vector<std::uint8_t> label_png(std::int32_t width_px, std::int32_t height_px, std::span<const std::int16_t> label,
                                    const std::vector<ClassState>& classes);

/// The response to a request for a picture: JSON of its facts, then JPEG, PNG of labels and PNG of entropy, each behind
/// its length in four bytes, little-endian; 0 for one that there is not. `is_spot`: the request was about a point.
std::string picture_bytes(const Picture& picture, const std::vector<ClassState>& classes, bool is_spot);

/// A photograph as JPEG, made smaller where its longest side is above `most_px`; 0: never.
std::vector<std::uint8_t> photo_jpeg(const Image<std::uint8_t>& photo, std::int32_t most_px);

/// JPEG by TurboJPEG. `rgb`: [height * width * 3]. Throws Error(internal) where TurboJPEG refuses.
std::vector<std::uint8_t> encode_jpeg(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> rgb,
                                      int quality = 85);

}  // namespace semfield::app
