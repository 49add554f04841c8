#!/bin/sh
# Makes the certificates of the tests anew. They last a hundred years, secure nothing, and lie here so that tests need no
# openssl. `stranger` comes from another authority.
set -eu
cd "$(dirname "$0")"
authority() {
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 36500 -subj "/CN=$1" \
        -addext "basicConstraints=critical,CA:TRUE" -keyout "$1.key" -out "$1.pem" 2>/dev/null
}
certificate() { # name authority usage [role]
    openssl req -new -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -subj "/CN=$1" -keyout "$1.key" \
        -out "$1.csr" 2>/dev/null
    printf 'basicConstraints=CA:FALSE\nextendedKeyUsage=%s\nsubjectAltName=DNS:device.example,IP:127.0.0.1\n' "$3" >"$1.ext"
    # Modbus/TCP Security: the role, as a text.
    [ -z "${4:-}" ] || printf '1.3.6.1.4.1.50316.802.1=ASN1:UTF8String:%s\n' "$4" >>"$1.ext"
    openssl x509 -req -in "$1.csr" -CA "$2.pem" -CAkey "$2.key" -CAcreateserial -days 36500 -extfile "$1.ext" \
        -out "$1.pem" 2>/dev/null
    rm "$1.csr" "$1.ext"
}
authority plant
authority elsewhere
certificate device plant serverAuth
certificate host plant clientAuth
certificate operator plant clientAuth operator
certificate viewer plant clientAuth viewer
certificate stranger elsewhere clientAuth
rm -f ./*.srl plant.key elsewhere.key
