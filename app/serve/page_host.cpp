#include "app/serve/page_host.h"

#include <arpa/inet.h>
#include <fmt/format.h>

#include <utility>

#include "app/serve/http_port.h"
#include "core/text.h"

namespace semfield::app {

namespace {

constexpr const char* kEveryAddress = "0.0.0.0";

HttpResponse forbidden(const std::string& why) { return {403, "text/plain", why + "\n"}; }

bool is_ipv4(const std::string& text) {
  in_addr number{};
  return inet_pton(AF_INET, text.c_str(), &number) == 1;
}

}  // namespace

namespace {

int status_of(ErrorKind kind) {
  if (kind == ErrorKind::data || kind == ErrorKind::usage) return 400;
  return kind == ErrorKind::internal ? 500 : 503;
}

}  // namespace

std::string error_json(Code code, const std::string& message, const std::string& remedy) {
  return json_text({{"error", message}, {"code", code.text()}, {"remedy", remedy}});
}

HttpResponse json_answer(const Json& json) { return {200, "application/json", json_text(json)}; }

HttpResponse safe_answer(const std::function<HttpResponse()>& answer) noexcept {
  try {
    try {
      return answer();
    } catch (const Error& e) {
      return {status_of(e.kind()), "application/json", error_json(e.code(), e.message(), e.remedy())};
    } catch (const std::exception& e) {
      return {500, "application/json",
              error_json("internal.exception", std::string("internal error: ") + e.what(), "")};
    }
  } catch (const std::exception&) {  // no memory
    return {500, "text/plain", ""};
  }
}

HttpResponse wrong_method(const char* allowed) {
  HttpResponse wrong{405, "application/json",
                     error_json("serve.request.method", "this address takes another method", "")};
  wrong.allow = allowed;
  return wrong;
}

std::string PageHost::url() const {
  return fmt::format("http://{}:{}/{}/", address_ == kEveryAddress ? "127.0.0.1" : address_, port_, token_);
}

// Takes the same time for every wrong token, so that none can be found byte by byte.
bool PageHost::is_token(const std::string& path) const {
  if (path.size() < token_.size() + 1 || path[0] != '/') return false;
  unsigned differs = 0;
  for (std::size_t i = 0; i < token_.size(); ++i)
    differs |= static_cast<unsigned char>(path[i + 1]) ^ static_cast<unsigned char>(token_[i]);
  return differs == 0 && (path.size() == token_.size() + 1 || path[token_.size() + 1] == '/');
}

// A name of somebody else that is made to point here (DNS rebinding) is no host of ours. A server of every address
// has many, but all are numbers.
bool PageHost::is_host(const std::string& host) const {
  const std::size_t colon = host.rfind(':');
  if (colon == std::string::npos || host.substr(colon + 1) != std::to_string(port_)) return false;
  const std::string name = lower_case(host.substr(0, colon));
  return name == "127.0.0.1" || name == "localhost" || name == address_ || (address_ == kEveryAddress && is_ipv4(name));
}

std::optional<HttpResponse> PageHost::refuse(const HttpRequest& head) const {
  if (!is_token(head.path)) return HttpResponse{404, "text/plain", "not found\n"};
  const std::string host = head.header("host").value_or("");
  if (head.header_count("host") != 1 || !is_host(host))
    return forbidden(
        fmt::format("the page is at {}:{} alone; a tunnel has to lead there from the same port (ssh -L "
                    "{}:127.0.0.1:{} ...)",
                    address_, port_, port_, port_));
  if (const auto origin = head.header("origin"); head.method == "POST" && origin && *origin != "http://" + host)
    return forbidden("a page of another origin may not send");
  const std::string site = head.header("sec-fetch-site").value_or("none");
  // A link that leads here from another page opens the page; it can neither read nor send.
  const bool opens = head.method == "GET" && head.header("sec-fetch-mode") == "navigate" &&
                     head.header("sec-fetch-dest") == "document";
  if (site != "none" && site != "same-origin" && !opens) return forbidden("a page of another site may not ask");
  if (head.path.size() == token_.size() + 1) {  // without the folder's slash relative addresses would leave it
    HttpResponse onward{308, "text/plain", ""};
    onward.location = head.path + "/";
    return onward;
  }
  return std::nullopt;
}

PageHost::PageHost(std::string token, HttpOptions http, bool next_port, std::string guide, Places places)
    : guide_(std::move(guide)), token_(std::move(token)), address_(http.address), places_(std::move(places)) {
  http.port = port_ = free_port(http.address, http.port, next_port);
  HttpHandler handler;
  handler.refuse = [this](const HttpRequest& head) {
    std::optional<HttpResponse> refused;
    const HttpResponse failed = safe_answer([&] {
      refused = refuse(head);
      return HttpResponse{};
    });
    return failed.status == 200 ? refused : failed;
  };
  handler.answer = [this](const HttpRequest& request) { return safe_answer([&] { return route(request); }); };
  http_.emplace(http, std::move(handler));
}

HttpResponse PageHost::route(const HttpRequest& request) {
  const std::string name = request.path.substr(token_.size() + 2);  // below the secret folder
  auto place = places_.find(name);
  if (const std::size_t slash = name.find('/'); place == places_.end() && slash != std::string::npos)
    place = places_.find(name.substr(0, slash + 1));
  if (place == places_.end())
    return {404, "application/json",
            error_json("serve.address.unknown", "nothing is at this address", "see " + guide_)};
  return request.method == place->second.method ? place->second.answer(request) : wrong_method(place->second.method);
}

}  // namespace semfield::app
