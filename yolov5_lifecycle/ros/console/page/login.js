/** Says that the token was refused: the server answers a wrong one with the address /login?refused. */

document.getElementById("refused").hidden = !new URLSearchParams(location.search).has("refused");
