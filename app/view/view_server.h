// The page of `semfield view` over HTTP: every address below the secret folder, and what it returns.
#pragma once

#include <string>
#include <vector>

#include "app/serve/page_server.h"
#include "app/view/viewed_run.h"

namespace semfield::app {

struct ViewOptions {
  HttpOptions http;
  bool next_port = false;  ///< when http.port is taken, one of the 99 behind it
  ExportOptions films;     ///< of the first run
  std::string page;        ///< live_page_text()
};

class ViewServer final : public PageHost {
 public:
  /// Serves when it returns; `runs`, one or two, must outlive it. Throws as free_port does.
  ViewServer(std::vector<ViewedRun*> runs, ViewOptions options);
  ~ViewServer() override { close(); }

 private:
  HttpResponse get_surface(const HttpRequest& request) const;
  HttpResponse get_probability(const HttpRequest& request) const;
  HttpResponse get_state() const;
  HttpResponse post_picture(const HttpRequest& request) const;
  HttpResponse post_point(const HttpRequest& request) const;
  HttpResponse post_edit(const HttpRequest& request) const;
  HttpResponse post_film(const HttpRequest& request);
  ViewedRun& run(std::uint64_t number) const;

  std::vector<ViewedRun*> runs_;
};

}  // namespace semfield::app
